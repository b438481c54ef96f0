"""The threshold and margin that an encoder ships with, from frames kept out of training.

Each trial is one query against a map that holds its place, or from which its place was taken out.
Three kinds of maps (validation.py) count alike: a street walk with either half of its references
left out, webcams over months, and webcams by night shifted sideways.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.calibration import FALSE_ACCEPTS, LOST_BY_MARGIN
from core.verdict import Calibration, Neighborhood, Whereabouts, judge
from training.validation import Cameras

Array = NDArray[np.float32]

NEIGHBORHOOD = Neighborhood(radius=5.0, frames=3)


@dataclass(frozen=True)
class Trials:
    """Outcomes of n queries: decision value, margin, whether the place was there, whether it was found."""

    decision: NDArray[np.float64]
    margin: NDArray[np.float64]
    known: NDArray[np.bool_]
    right: NDArray[np.bool_]


def trials(scores: Array, truth: NDArray[np.bool_], calibration: Calibration, examined: int) -> Trials:
    """Judge every query against one map whose places are consecutive frames.

    Args:
        scores: float32 [Q, R].
        truth: bool [Q, R].
        examined: candidates of the encoder's second stage; 0 without one.
    """
    rows = []
    places = scores.shape[1]
    frames = Whereabouts(
        np.zeros(places, np.int8), np.zeros((places, 3)), np.zeros(places, np.int32), np.arange(places, dtype=np.int64)
    )
    for query, true in zip(scores, truth, strict=True):
        order = np.argsort(-query, kind="stable")
        judgement = judge(query[order], frames.take(order), calibration, NEIGHBORHOOD, examined)
        rows.append((judgement.decision, judgement.margin, true.any(), true[order[0]]))
    decision, margin, known, right = (np.array(column) for column in zip(*rows, strict=True))
    return Trials(decision.astype(float), margin.astype(float), known.astype(bool), right.astype(bool))


def joined(parts: list[Trials]) -> Trials:
    """Several sets of trials as one."""
    fields = ("decision", "margin", "known", "right")
    return Trials(*(np.concatenate([getattr(part, field) for part in parts]) for field in fields))


def walk_trials(
    truth: NDArray[np.bool_], halves: Sequence[tuple[slice, Array]], calibration: Calibration, examined: int
) -> Trials:
    """A walk against maps of parts of its references: bool [Q, R], and of each part the scores, float32 [Q, part]."""
    return joined([trials(scores, truth[:, part], calibration, examined) for part, scores in halves])


def camera_trials(task: Cameras, scores: Array, distractors: Array, calibration: Calibration, examined: int) -> Trials:
    """One reference a camera among the distractors, and the same map without it.

    Args:
        scores: float32 [n, n] among the pictures.
        distractors: float32 [n, m] of the pictures against the distractors.
    """
    cameras = np.unique(task.camera)
    first = {c: int(np.flatnonzero((task.camera == c) & task.reference)[0]) for c in cameras}
    parts = []
    for camera in cameras:
        asked = np.flatnonzero((task.camera == camera) & task.query & (np.arange(len(scores)) != first[camera]))
        others = [first[c] for c in cameras if c != camera]
        without = np.hstack([distractors[asked], scores[np.ix_(asked, np.array(others))]])
        nothing = np.zeros(without.shape, np.bool_)
        parts.append(trials(without, nothing, calibration, examined))
        whole = np.hstack([without, scores[asked, first[camera]][:, None]])
        truth = np.hstack([nothing, np.ones((len(asked), 1), np.bool_)])
        parts.append(trials(whole, truth, calibration, examined))
    return joined(parts)


def choose(maps: list[Trials], calibration: Calibration) -> Calibration:
    """Threshold and margin for trials on several kinds of maps, each kind counting alike.

    The margin is the highest that costs at most LOST_BY_MARGIN of the right answers.  The threshold
    is the lowest at which, with that margin, at most FALSE_ACCEPTS of the unknown places are
    recognized, averaged over the kinds.
    """
    margin = max(0.0, float(np.quantile(np.concatenate([t.margin[t.right] for t in maps]), LOST_BY_MARGIN)))
    strangers = [t.decision[~t.known & (t.margin >= margin)] for t in maps]
    unknown = [int((~t.known).sum()) for t in maps]
    steps = np.linspace(-1, 20, 4201)
    accepted = [[float((s >= step).sum()) / n for step in steps] for s, n in zip(strangers, unknown, strict=True)]
    threshold = float(steps[int(np.argmax(np.mean(accepted, axis=0) <= FALSE_ACCEPTS))])
    return calibration.model_copy(update={"threshold": round(threshold, 3), "margin": round(margin, 5)})


def rates(t: Trials, calibration: Calibration) -> dict[str, float]:
    """What the verdicts do: unknown places recognized, known places recognized and right, or wrong."""
    recognized = (t.decision >= calibration.threshold) & (t.margin >= calibration.margin)
    return {
        "unknown_recognized": float(recognized[~t.known].mean()),
        "known_recognized_right": float((recognized & t.right)[t.known].mean()),
        "known_recognized_wrong": float((recognized & ~t.right)[t.known].mean()),
    }
