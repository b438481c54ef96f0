"""The curve, threshold and margin that an encoder ships with, from frames kept out of training.

Each trial is one query against a map that holds its place, or from which its place was taken out.
Three kinds of maps (validation.py) count alike: a street walk with either half of its references
left out, webcams over months, and webcams by night shifted sideways.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.judgement.calibration import FALSE_ACCEPTS, LOST_BY_MARGIN
from core.judgement.probability import Curve, fit_curve
from core.judgement.reliability import reliability
from core.judgement.trials import Trial, Trials, gathered, joined
from core.judgement.verdict import Calibration, judge
from core.places import Neighborhood, Whereabouts
from training.validation import Cameras

Array = NDArray[np.float32]

NEIGHBORHOOD = Neighborhood(radius=5.0, frames=3)


def trials(scores: Array, truth: NDArray[np.bool_], calibration: Calibration, examined: int) -> Trials:
    """Judge every query against one map whose places are consecutive frames.

    Args:
        scores: float32 [Q, R].
        truth: bool [Q, R].
        examined: candidates of the encoder's second stage; 0 without one.
    """
    made = []
    places = scores.shape[1]
    frames = Whereabouts(
        np.zeros(places, np.int8), np.zeros((places, 3)), np.zeros(places, np.int32), np.arange(places, dtype=np.int64)
    )
    for number, (query, true) in enumerate(zip(scores, truth, strict=True)):
        order = np.argsort(-query, kind="stable")
        judgement = judge(query[order], frames.take(order), calibration, NEIGHBORHOOD, examined)
        made.append(Trial(judgement, bool(true.any()), bool(true[order[0]]), number))
    return gathered(made)


def walk_trials(
    truth: NDArray[np.bool_], halves: Sequence[tuple[slice, Array]], calibration: Calibration, examined: int
) -> Trials:
    """A walk against maps of parts of its references: bool [Q, R], and of each part the scores, float32 [Q, part]."""
    parts = [trials(scores, truth[:, part], calibration, examined) for part, scores in halves]
    return joined(parts, same_frames=True)


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
        whole = np.hstack([without, scores[asked, first[camera]][:, None]])
        truth = np.hstack([nothing, np.ones((len(asked), 1), np.bool_)])
        pair = [(without, nothing), (whole, truth)]
        parts.append(joined([trials(*one, calibration, examined) for one in pair], same_frames=True))
    return joined(parts)


def choose(maps: list[Trials], calibration: Calibration) -> Calibration:
    """Curve, threshold and margin for trials on several kinds of maps, each kind counting alike.

    The margin is the highest that costs at most LOST_BY_MARGIN of the right answers.  The threshold
    is the lowest at which, with that margin, at most FALSE_ACCEPTS of the unknown places are
    recognized, averaged over the kinds.
    """
    margin = max(0.0, float(np.quantile(np.concatenate([t.margin[t.right] for t in maps]), LOST_BY_MARGIN)))
    strangers = [t.decision[~t.known & (t.margin >= margin)] for t in maps]
    unknown = [int((~t.known).sum()) for t in maps]
    steps = np.linspace(0, 1, 4001)
    accepted = [[float((s >= step).sum()) / n for step in steps] for s, n in zip(strangers, unknown, strict=True)]
    threshold = float(steps[int(np.argmax(np.mean(accepted, axis=0) <= FALSE_ACCEPTS))])
    every = joined(maps)
    shares = np.concatenate([np.full(len(t), 1 / len(t)) for t in maps])
    fitted = fit_curve(every.decision, every.right, shares)
    curve = Curve(slope=round(fitted.slope, 3), intercept=round(fitted.intercept, 4))
    frames = len(np.unique(every.frame))
    found = {"threshold": round(threshold, 4), "margin": round(margin, 5), "curve": curve, "frames": frames}
    return calibration.model_copy(update=found)


def rates(t: Trials, calibration: Calibration) -> dict[str, float]:
    """What the verdicts do: unknown places recognized, known places recognized and right, or wrong."""
    recognized = (t.decision >= calibration.threshold) & (t.margin >= calibration.margin)
    return {
        "unknown_recognized": float(recognized[~t.known].mean()),
        "known_recognized_right": float((recognized & t.right)[t.known].mean()),
        "known_recognized_wrong": float((recognized & ~t.right)[t.known].mean()),
    }


def worth(t: Trials, calibration: Calibration) -> dict[str, float]:
    """What the probabilities are worth: calibration error, and the Brier score by that of the constant base rate."""
    found = reliability(t.probabilities(calibration), t.right)
    return {"ece": found.ece, "brier": found.brier, "brier_by_base_rate": found.brier / found.brier_of_base_rate}
