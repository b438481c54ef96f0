"""The job that learns from a run: frames whose place the whole run knows beyond doubt are proposed as looks.

It works on the notes of a run that is over (:mod:`service.learning.run_notes`), after the requests that wait.
Proposals wait among the frames stored for review until a person accepts them or, with the setting ``auto``, until
independent evidence agrees (:mod:`service.learning.adoption`).
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import aclosing
from dataclasses import replace
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from core.belief import PlaceGraph
from core.errors import PlacerecError, UnknownCamera
from core.frames.masks import Mask
from core.judgement.trials import StagedTrials
from core.learning import (
    Lesson,
    LessonOptions,
    Proposal,
    RunFrame,
    Trail,
    cohort_of,
    least_score,
    lesson_of,
    placed_frames,
    trials_of,
)
from core.learning.proposals import LEAST_ANCHORS
from core.maps import ReviewSetting
from core.maps.records import MOST_LOOKS
from core.maps.stored_fields import moment_text
from core.method.encoder import Encoder
from core.recognition.calibration import ProgressCallback
from core.recognition.stages import calibration_of
from core.store import Map
from service.access.audit import ASKER
from service.engine.encoders import Encoded
from service.engine.engine import Engine
from service.engine.queue import RequestDeadline
from service.jobs.context import JobContext, progress_of, run_after_requests
from service.jobs.jobs import Jobs
from service.learning import new_ground
from service.learning.adoption import Adoption, graph_of, likeness_of_encodings
from service.learning.run_notes import RunNotes
from service.places.place_events import tell_change

KIND = "learn"

log = logging.getLogger("placerec.learning")

Calibrate = Callable[[Map, RunNotes, StagedTrials], Mapping[str, Any]]
"""Has a map calibrated by the frames of a run; returns JSON that tells what became of that."""

Unproposed = Literal["surer frame", "no score", "most looks", "not kept"]
"""Why a frame that the rest of the run is certain of is not proposed: another frame of the run shows the place more
surely; the run does not tell from which score on a match with it is to be believed; its place has all looks that it
may have, or is gone; or the same file is under review with a label, or is larger than all frames there may be together.
"""

AFTERWARDS: tuple[Unproposed, ...] = get_args(Unproposed)

TOGETHER = 16
"""Frames that are encoded together; in between, requests go first."""


def submit(
    engine: Engine,
    jobs: Jobs,
    map_id: str,
    made: str,
    camera: str | None,
    notes: RunNotes,
    erased: Callable[[RunNotes], bool],
    calibrate: Calibrate,
) -> None:
    """Have a run's lesson drawn by a job; a run of too few frames teaches nothing.

    If no job can be submitted now, the run teaches nothing, and the log says so.

    Args:
        map_id, made: of the map, and when it was created.
        camera: of the session.
        erased: whether frames of a run were erased since it began; then it teaches nothing.
        calibrate: takes what the run says of the map's answers.
    """
    if len(notes.frames) < LEAST_ANCHORS:
        return
    work = partial(learn, engine, notes, camera, erased, calibrate)
    arguments = {"session": notes.session, "frames": len(notes.frames)}
    present = ASKER.set(notes.robot)  # whoever ends the session: the audit trail names who has taught the map
    try:
        jobs.submit(KIND, map_id, work, arguments, {map_id: made})
    except PlacerecError as error:
        log.warning("session %s teaches its map nothing: %s", notes.session, error)
    finally:
        ASKER.reset(present)


def learn(
    engine: Engine,
    notes: RunNotes,
    camera: str | None,
    erased: Callable[[RunNotes], bool],
    calibrate: Calibrate,
    context: JobContext,
) -> Mapping[str, Any]:
    """Propose looks from a run that is over, and what it says of the map's calibration.

    Args:
        camera: of the session.
        erased, calibrate: as of :func:`submit`.  Jobs of one map run one after another, so that nothing is erased
            meanwhile.

    Returns:
        JSON: the frames of the run, how many of them were proposed as looks, and how many were not, by the reason
        (``Refusal``, ``Unproposed``); and what became of the calibration, if the run says anything of it.

    Raises:
        UnknownMap, EncoderNotInstalled, StorageFull, StorageFailure: nothing but proposals was stored.
        JobCancelled, JobInterrupted: likewise.
    """
    map_ = context.map(engine.maps)
    setting = map_.record.learning
    found: dict[str, Any] = {"session": notes.session, "frames": len(notes.frames), "proposals": 0}
    if setting.mode == "off":
        return found | {"contradiction": "off"}
    if erased(notes):
        notes.frames.clear()
        return found | {"contradiction": "erased"}
    encoder = engine.load_encoder(map_)
    encoded = _encoded(engine, map_, [noted.data for noted in notes.frames], [camera] * len(notes.frames), context)
    frames = [
        replace(noted.frame, keypoints=None if isinstance(one, Exception) else one.keypoints)
        for noted, one in zip(notes.frames, encoded, strict=True)
    ]
    graph = graph_of(map_)
    lesson = lesson_of(frames, graph, LessonOptions(least_probability=setting.least_probability))
    scores = _Scores(encoder, encoded)
    surest, trail = best_of_places(lesson.proposals), Trail.of(frames)
    refused = Counter[str](lesson.refused)
    refused["surer frame"] = len(lesson.proposals) - len(surest)
    for proposal in surest:
        context.check_cancelled()
        least = _least(proposal.frame, trail, graph, scores, map_, encoder)
        reason = "no score" if least is None else _propose(map_, notes, proposal, least)
        if reason is not None:
            refused[reason] += 1
    found |= {
        "proposals": len(lesson.proposals) - sum(refused[reason] for reason in AFTERWARDS),
        "contradiction": lesson.contradiction,
        "anchors": len(lesson.anchors),
        "refused": {reason: count for reason, count in refused.items() if count},
    }
    if setting.calibration != "off":
        context.check_cancelled()
        trials = _asked(map_, encoder, lesson, frames, encoded, progress_of(engine, context, "asking frames again"))
        if len(trials):
            found |= {"calibration": calibrate(map_, notes, trials)}
    if setting.new_ground:
        context.check_cancelled()

        def ground_least(number: int) -> float | None:
            one = encoded[number]
            if isinstance(one, Exception) or not len(one.encoding.regions):
                return None
            return _least(number, trail, graph, scores, map_, encoder)

        found |= {"new_ground": new_ground.propose(map_, notes, frames, graph, lesson, ground_least)}
    if setting.mode != "auto":
        return found

    def encode(files: Sequence[bytes], cameras: Sequence[str | None], pixels: bool) -> list[Encoded | Exception]:
        return _encoded(engine, map_, files, cameras, context, pixels)

    adoption = Adoption(map_, encoder, graph, encode, setting)
    withdrawn = adoption.observe(lesson, frames)
    context.check_cancelled()
    took = adoption.take()
    withdrawn += took.withdrawn + (adoption.rehearse(lesson, frames, encoded) if took.looks else 0)
    tell_change(engine, map_, "look-added", took.looks)
    tell_change(engine, map_, "look-removed", withdrawn)
    return found | {"taken": took.looks, "withdrawn": withdrawn}


def _asked(
    map_: Map,
    encoder: Encoder,
    lesson: Lesson,
    frames: Sequence[RunFrame],
    encoded: Sequence[Encoded | Exception],
    advance: ProgressCallback,
) -> StagedTrials:
    """The answers of the map to the frames of a run whose places it knows, with their places and without them."""
    found = [
        (placed, one)
        for placed in placed_frames(lesson, frames)
        if not isinstance(one := encoded[placed.number], Exception) and len(one.encoding.regions)
    ]
    keypoints = [one.keypoints if map_.record.verification else None for _, one in found]
    return trials_of(
        map_, encoder, [placed for placed, _ in found], [one.encoding for _, one in found], keypoints, advance
    )


def best_of_places(proposals: Sequence[Proposal]) -> list[Proposal]:
    """Of several proposals of a run for one place the surest; in the order of the frames."""
    best: dict[int, Proposal] = {}
    for one in proposals:
        if one.row not in best or one.certainty > best[one.row].certainty:
            best[one.row] = one
    return sorted(best.values(), key=lambda one: one.frame)


class _Scores:
    """The scores of frames of a run against one another."""

    def __init__(self, encoder: Encoder, encoded: Sequence[Encoded | Exception]) -> None:
        self._encoder, self._encoded = encoder, encoded

    def of(self, frame: int, others: NDArray[np.int64]) -> NDArray[np.float32]:
        """The scores of both stages of a frame against others that could be encoded; float32 [k]."""
        chosen = [self._encoded[number] for number in (frame, *others.tolist())]
        usable = [one.encoding for one in chosen if not isinstance(one, Exception)]
        if isinstance(chosen[0], Exception) or len(usable) < 2:
            return np.zeros(0, np.float32)
        return likeness_of_encodings(self._encoder, usable)


def _encoded(
    engine: Engine,
    map_: Map,
    files: Sequence[bytes],
    cameras: Sequence[str | None],
    context: JobContext,
    pixels: bool = False,
) -> list[Encoded | Exception]:
    """Frames with their keypoints, encoded after the requests that wait.

    Args:
        cameras: of the frames, whose masks are applied.
        pixels: keep their pixels, too.
    """
    masks = {camera: _mask(map_, camera) for camera in set(cameras)}
    found: list[Encoded | Exception] = []
    for first in range(0, len(files), TOGETHER):
        some = files[first : first + TOGETHER]
        ignored = [masks[camera] for camera in cameras[first : first + TOGETHER]]

        async def encode(
            deadline: RequestDeadline, some: Sequence[bytes] = some, ignored: Sequence[Mask | None] = ignored
        ) -> dict[int, Encoded | Exception]:
            made: dict[int, Encoded | Exception] = {}
            many = engine.queue.encode_many(map_.record.encoder, some, deadline, ignored, keypoints=True)
            async with aclosing(many) as outcomes:
                async for done in outcomes:
                    for index, one in done:
                        made[index] = one if isinstance(one, Exception) or pixels else one.without_pixels()
            return made

        made = run_after_requests(engine, context, encode)
        found += [made[index] for index in range(len(some))]
        context.progress(len(found), len(files), "encoding frames")
    return found


def _mask(map_: Map, camera: str | None) -> Mask | None:
    try:
        return None if camera is None else map_.cameras.mask(camera)
    except UnknownCamera:  # it was deleted during the run
        return None


def _least(frame: int, trail: Trail, graph: PlaceGraph, scores: _Scores, map_: Map, encoder: Encoder) -> float | None:
    """The score from which on a match with a frame of the run is believed; None if the run does not tell it."""
    cohort = cohort_of(trail, frame, graph)
    beside, far = (scores.of(frame, part) for part in (cohort.beside, cohort.far))
    return least_score(beside, far, calibration_of(map_, encoder))


def _propose(map_: Map, notes: RunNotes, proposal: Proposal, least: float) -> Unproposed | None:
    """Store a proposal for review; returns why it was not stored."""
    (place,) = map_.places_at([proposal.row])
    if place is None or place.looks >= MOST_LOOKS:
        return "most looks"
    noted = notes.frames[proposal.frame]
    told = {
        "place": place.id,
        "certainty": round(proposal.certainty, 6),
        "frame": proposal.frame,
        "anchors": list(proposal.anchors),
        "misfit": round(proposal.misfit, 3),
        "distance": round(proposal.distance, 3),
        "geometry": None if proposal.geometry is None else round(proposal.geometry, 1),
        "why": proposal.why,
        "run": notes.session,
        "source": str(notes.source),
        "least_score": least,
        "taken": moment_text(noted.taken),
    }
    setting = map_.record.review or ReviewSetting()
    kept = map_.review.keep(noted.data, {**noted.answer, "proposal": told}, setting, renew=True)
    return None if kept else "not kept"
