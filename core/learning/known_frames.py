"""The frames of a run whose place the rest of the run knows beyond doubt: as good as labelled ones, for a calibration.

A frame's own evidence has no part in that knowledge (``smoothing.py``), or an answer would prove itself.  Each is asked
again, and some in the map without their places, too: a run through a map meets few strangers, and known places alone do
not say what the map answers to them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from core.geometry.keypoints import Keypoints
from core.judgement.trials import StagedTrials
from core.learning.frames import RunFrame
from core.learning.proposals import LEAST_PROBABILITY, Lesson
from core.method.encoder import Encoder, Encoding
from core.recognition.calibration import ProgressCallback, queries_from_rows, run_trials, spread
from core.store import Map

MOST_ASKED = 300
"""Frames of a run that are asked again at most, evenly spread over it: as many as of a traverse."""


STRANGERS = 3
"""Every third frame is asked without its place, too, as if of four frames one were a stranger.  If every frame is, a
robot that stays on the map is believed too little afterwards; if every fourth, one of 1 565 frames from elsewhere was
recognized (``benchmarks.learning.calibration``)."""


class PlacedFrame(NamedTuple):
    """A frame of a run: its number, and the row of the map that shows its place; None: the map lacks it."""

    number: int
    row: int | None


def placed_frames(lesson: Lesson, frames: Sequence[RunFrame], least: float = LEAST_PROBABILITY) -> list[PlacedFrame]:
    """The frames of a run that is beyond doubt about where they were taken.

    Views that are covered, or constant, say nothing and are left out.

    Args:
        lesson: of the run; one that teaches nothing places no frames.
        least: the probability by the rest of the run from which a frame counts as one of a place that the map lacks;
            the lesson has its own for the places of the map.
    """
    if lesson.contradiction is not None:
        return []
    found: list[PlacedFrame] = []
    for number, frame in enumerate(frames):
        if frame.sight is not None:
            continue
        if (row := int(lesson.rows[number])) >= 0:
            found.append(PlacedFrame(number, row))
        elif lesson.away[number] >= least:
            found.append(PlacedFrame(number, None))
    return found


def trials_of(
    map_: Map,
    encoder: Encoder,
    placed: Sequence[PlacedFrame],
    encodings: Sequence[Encoding],
    keypoints: Sequence[Keypoints | None],
    advance: ProgressCallback,
) -> StagedTrials:
    """The answers of a map to frames of a run whose places it knows, and to some of them without their places.

    Frames of places that were deleted since are left out.

    Args:
        encodings, keypoints: of the frames ``placed``, in their order.

    Raises:
        StorageFailure: the map's files cannot be read.
        Others: what ``advance`` raises.
    """
    snapshot = map_.snapshot()
    chosen = [
        at
        for at in spread(list(range(len(placed))), MOST_ASKED)
        if (row := placed[at].row) is None or (row < snapshot.rows and snapshot.alive[row])
    ]
    queries = queries_from_rows(
        map_,
        snapshot,
        [encodings[at] for at in chosen],
        [placed[at].row for at in chosen],
        keypoints=[keypoints[at] for at in chosen],
    )
    return run_trials(map_, encoder, snapshot, queries, encoder.calibration, advance, STRANGERS)
