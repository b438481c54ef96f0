"""One moment's frames asked of several maps: each frame encoded once for each encoder, the maps ranked together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from core import errors
from core.frames.masks import Mask
from core.judgement.fusion import ALIKE, joint_probabilities, log_odds_of
from core.judgement.priors import log_odds_per_score
from core.judgement.verdict import Verdict
from core.recognition.recognition import Answer
from core.recognition.rigs import locate_rig
from core.recognition.selection import Selection
from core.storage import Map
from service.engine.engine import Engine, camera_mask, in_thread
from service.engine.queue import Encoded, RequestDeadline
from service.errors.faults import EncoderNotInstalled

MAP_ERRORS = (
    errors.UnknownMap,
    errors.MapQuarantined,
    errors.StorageFailure,
    errors.UnknownCamera,
    errors.UnknownEncoder,
    errors.InvalidModel,
    EncoderNotInstalled,
)
"""What keeps one map from answering and none of the others."""


@dataclass(frozen=True)
class RigFrame:
    """One of the frames of a moment: its name, its bytes, and the camera that took it, if that is said."""

    name: str
    data: bytes
    camera: str | None = None


@dataclass(frozen=True)
class MapReport:
    """What became of a map: located, or else the error that kept it from answering.

    frames: of each frame what was encoded, or why it could not be; None where no encoder was asked.
    """

    map_id: str
    map_: Map | None = None
    located: Answer | None = None
    error: Exception | None = None
    frames: tuple[Encoded | Exception, ...] = ()

    @property
    def log_odds(self) -> float:
        """Of the map's best match being right."""
        assert self.located is not None
        return log_odds_of(self.located.judgement, self.located.calibration)


@dataclass(frozen=True)
class JointVerdict:
    """The verdict over all maps.

    best: the report of the map whose match is the most probable; None if none found any.
    probability: that this match is right, the other maps' considered; None if its map's calibration cannot tell.
    """

    verdict: Verdict
    best: MapReport | None
    probability: float | None


async def locate_in_maps(
    engine: Engine,
    map_ids: Sequence[str],
    frames: Sequence[RigFrame],
    k: int,
    selection: Selection | None,
    deadline: RequestDeadline,
) -> list[MapReport]:
    """What each map says of the frames, in the order of the ids; call it within ``queue.place``.

    Raises:
        QueueFull, DeadlineExceeded, ClientGone: of the request as a whole.
    """
    maps: dict[str, Map] = {}
    masks: dict[str, list[Mask | None]] = {}
    reports: dict[str, MapReport] = {}
    for map_id in map_ids:
        try:
            maps[map_id] = await engine.map(map_id)
            masks[map_id] = [await camera_mask(maps[map_id], frame.camera) for frame in frames]
        except MAP_ERRORS as error:
            reports[map_id] = MapReport(map_id, maps.pop(map_id, None), error=error)
    encoded = await _encode(engine, maps, masks, frames, deadline)
    for map_id, map_ in maps.items():
        outcome = encoded[map_id]
        if isinstance(outcome, Exception):
            reports[map_id] = MapReport(map_id, map_, error=outcome)
            continue
        seen = [one for one in outcome if isinstance(one, Encoded) and len(one.encoding.regions)]
        amiss = next((one for one in outcome if isinstance(one, MAP_ERRORS)), None)
        report = MapReport(map_id, map_, error=amiss, frames=tuple(outcome))
        if seen and amiss is None:
            encodings = [one.encoding for one in seen]
            try:
                located = await in_thread(locate_rig, map_, seen[0].encoder, encodings, k, selection)
                report = replace(report, located=located)
            except MAP_ERRORS as error:
                report = replace(report, error=error)
        reports[map_id] = report
    return [reports[map_id] for map_id in map_ids]


async def _encode(
    engine: Engine,
    maps: dict[str, Map],
    masks: dict[str, list[Mask | None]],
    frames: Sequence[RigFrame],
    deadline: RequestDeadline,
) -> dict[str, list[Encoded | Exception] | Exception]:
    """By map what became of each frame: those that share an encoder and a mask share the work."""
    wanted: dict[str, dict[tuple[int, str], Mask | None]] = {}
    for map_id, map_ in maps.items():
        for index, mask in enumerate(masks[map_id]):
            wanted.setdefault(map_.record.encoder, {})[index, _key(mask)] = mask
    made: dict[str, dict[tuple[int, str], Encoded | Exception] | Exception] = {}
    for map_ in maps.values():
        identity = map_.record.encoder
        if identity in made:
            continue
        keys = list(wanted[identity])
        try:
            outcomes = await engine.encode_all(
                identity, [frames[index].data for index, _ in keys], deadline, list(wanted[identity].values())
            )
            made[identity] = dict(zip(keys, outcomes, strict=True))
        except MAP_ERRORS as error:
            made[identity] = error
    found: dict[str, list[Encoded | Exception] | Exception] = {}
    for map_id, map_ in maps.items():
        by_key = made[map_.record.encoder]
        if isinstance(by_key, Exception):
            found[map_id] = by_key
        else:
            found[map_id] = [by_key[index, _key(mask)] for index, mask in enumerate(masks[map_id])]
    return found


def _key(mask: Mask | None) -> str:
    return "" if mask is None else mask.digest


def judge_together(reports: Sequence[MapReport]) -> JointVerdict:
    """The verdict over the maps that answered: that of the most probable match's own map, unless another map has a
    match of another place that is nearly as probable, which makes it ambiguous."""
    found = [report for report in reports if report.located is not None and report.located.matches]
    if not found:
        return JointVerdict("unknown", None, None)
    best, *others = sorted(found, key=lambda report: -report.log_odds)
    rivals = [report.log_odds for report in others if not _same_place(best, report)]
    assert best.located is not None
    judgement = best.located.judgement
    verdict = judgement.verdict
    if verdict == "recognized" and rivals and best.log_odds - rivals[0] < ALIKE:
        verdict = "ambiguous"
    if judgement.probability is None:
        return JointVerdict(verdict, best, None)
    return JointVerdict(verdict, best, float(joint_probabilities([best.log_odds, *rivals])[0]))


def _same_place(a: MapReport, b: MapReport) -> bool:
    """Whether the best matches of two maps are one place on the Earth; metres are those of each map's own frame."""
    assert a.located is not None and b.located is not None
    assert a.map_ is not None and b.map_ is not None
    poses = [report.located.matches[0][1].pose for report in (a, b) if report.located is not None]
    first, second = poses
    if first is None or second is None or first.kind() != "geographic" or second.kind() != "geographic":
        return False
    reach = max(a.map_.record.same_place_radius, b.map_.record.same_place_radius)
    return float(np.linalg.norm(first.position() - second.position())) <= reach


def match_log_odds(report: MapReport) -> list[float]:
    """Of each match of a map, to rank the matches of several maps together: those of the best match, less by what
    the match scores less, with what is known of it."""
    located = report.located
    assert located is not None
    ordered = located.candidates.ordered[: len(located.matches)].astype(np.float64)
    steepness = log_odds_per_score(located.calibration, bool(located.candidates.examined.any()))
    return (report.log_odds - steepness * (ordered[0] - ordered)).tolist() if len(ordered) else []
