"""Queries of several maps at once: each frame is encoded once per encoder, and all matches are ranked together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from core import errors
from core.frames.masks import Mask
from core.geometry.keypoints import Keypoints
from core.judgement.fusion import ALIKE, joint_probabilities, log_odds_of
from core.judgement.priors import decision_slope
from core.judgement.verdict import EVEN, Verdict, least_probability
from core.places import GEOGRAPHIC, Whereabouts
from core.recognition.question import Question
from core.recognition.recognition import Answer
from core.recognition.rigs import locate_rig
from core.recognition.stages import neighborhood_of
from core.store import Map
from service.engine.encoders import Encoded
from service.engine.engine import Engine, camera_mask
from service.engine.queue import RequestDeadline
from service.errors.faults import EncoderNotInstalled
from service.worker_threads import in_thread

MAP_ERRORS = (
    errors.UnknownMap,
    errors.MapQuarantined,
    errors.StorageFailure,
    errors.UnknownCamera,
    errors.MixedCoordinates,
    errors.UnknownEncoder,
    errors.InvalidModel,
    EncoderNotInstalled,
)
"""Errors that prevent the answer of one map, but not those of the other maps."""


@dataclass(frozen=True)
class RigFrame:
    """One frame of a rig: its name, the bytes of its file, and the name of its camera, if it is given."""

    name: str
    data: bytes
    camera: str | None = None


@dataclass(frozen=True)
class MapReport:
    """The answer of one map, or the error that prevented it.

    map_: None if the map could not be opened.
    answer: None if there is an error, or if no frame has regions.
    frames: each frame as the map's encoder encoded it, or the error of that; empty if the encoder was not used.
    """

    map_id: str
    map_: Map | None = None
    answer: Answer | None = None
    error: Exception | None = None
    frames: tuple[Encoded | Exception, ...] = ()

    @property
    def log_odds(self) -> float:
        """The log odds that the map's best match is right."""
        assert self.answer is not None
        return log_odds_of(self.answer.judgement, self.answer.calibration)


@dataclass(frozen=True)
class JointVerdict:
    """The verdict over all maps.

    best: the report of the map with the most probable match; None if no map has a match.
    probability: the probability that this match is right, given the matches of the other maps; None if the calibration
        of its map has no curve.
    """

    verdict: Verdict
    best: MapReport | None
    probability: float | None


async def locate_in_maps(
    engine: Engine,
    map_ids: Sequence[str],
    frames: Sequence[RigFrame],
    question: Question,
    deadline: RequestDeadline,
) -> list[MapReport]:
    """Locate the frames of a rig in each of several maps; call it within ``queue.place``.

    Args:
        question: its camera does not count; each frame has its own.

    Returns:
        One report for each map, in the order of the ids.

    Raises:
        QueueFull, DeadlineExceeded, ClientGone: the whole request fails.
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
    encoded = await _encode(engine, maps, masks, frames, deadline, keep_scaled=question.verify != "never")
    finders: dict[tuple[int, str], Callable[[], Keypoints]] = {}  # by frame and mask, the same for every encoder
    for map_id, map_ in maps.items():
        outcome = encoded[map_id]
        if isinstance(outcome, Exception):
            reports[map_id] = MapReport(map_id, map_, error=outcome)
            continue
        seen = [
            (index, one) for index, one in enumerate(outcome) if isinstance(one, Encoded) and len(one.encoding.regions)
        ]
        failure = next((one for one in outcome if isinstance(one, MAP_ERRORS)), None)
        report = MapReport(map_id, map_, error=failure, frames=tuple(outcome))
        if seen and failure is None:
            try:
                # The pose of a rig does not come from the geometry of one of its cameras.
                camera = frames[seen[0][0]].camera if len(seen) == 1 else None
                queries = [
                    replace(
                        one.query(replace(question, camera=camera)),
                        find_keypoints=finders.setdefault((index, _key(one.mask)), cache(one.find_keypoints)),
                    )
                    for index, one in seen
                ]
                answer = await in_thread(locate_rig, map_, seen[0][1].encoder, queries)
                report = replace(report, answer=answer)
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
    keep_scaled: bool,
) -> dict[str, list[Encoded | Exception] | Exception]:
    """The encoded frames for each map, or errors; maps with the same encoder and mask share an encoding."""
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
                identity,
                [frames[index].data for index, _ in keys],
                deadline,
                list(wanted[identity].values()),
                keep_scaled=keep_scaled,
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
    """The verdict over all maps that answered.

    It is the verdict of the map with the most probable match.  If another map has a match of another place that is
    nearly as probable, or those of all leave less than its threshold demands, the verdict is ``ambiguous`` instead of
    ``recognized``.  The probability of an ambiguous answer is a half at most.
    """
    found = [report for report in reports if report.answer is not None and report.answer.matches]
    if not found:
        return JointVerdict("unknown", None, None)
    best, *others = sorted(found, key=lambda report: -report.log_odds)
    rivals = [report.log_odds for report in others if not _same_place(best, report)]
    assert best.answer is not None
    judgement = best.answer.judgement
    verdict = judgement.verdict
    if verdict == "recognized" and rivals and best.log_odds - rivals[0] < ALIKE:
        verdict = "ambiguous"
    if judgement.probability is None:
        return JointVerdict(verdict, best, None)
    probability = float(joint_probabilities([best.log_odds, *rivals])[0])
    if verdict == "recognized" and rivals and probability < least_probability(judgement, best.answer.calibration):
        verdict = "ambiguous"
    return JointVerdict(verdict, best, min(EVEN, probability) if verdict == "ambiguous" else probability)


def _same_place(a: MapReport, b: MapReport) -> bool:
    """Whether the best matches of two maps are the same place on the Earth.

    Metric poses say nothing about this, because each map has a frame of its own.
    """
    assert a.answer is not None and b.answer is not None
    assert a.map_ is not None and b.map_ is not None
    both = Whereabouts.joined(report.answer.candidates.whereabouts.take([0]) for report in (a, b) if report.answer)
    reach = max((neighborhood_of(map_) for map_ in (a.map_, b.map_)), key=lambda one: one.radius)
    return bool((both.kind == GEOGRAPHIC).all() and both.near(0, reach)[1])


def match_log_odds(report: MapReport) -> list[float]:
    """The log odds of each match of a map, by which the matches of several maps are ranked together.

    Those of the best match come from the verdict.  Those of another match are lower in proportion to how much its
    score is lower.
    """
    answer = report.answer
    assert answer is not None
    ordered = answer.candidates.values[: len(answer.matches)].astype(np.float64)
    steepness = decision_slope(answer.calibration)
    return (report.log_odds - steepness * (ordered[0] - ordered)).tolist() if len(ordered) else []
