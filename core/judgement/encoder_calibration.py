"""A curve, a threshold and a margin for an encoder of one's own, from frames kept out of its training.

Every frame held out is a query twice.  As it is, against the frames that are not its neighbours: a
place that the map does not have.  And as a *second look*, disturbed, against all of them: a place
that it has.  Real second visits differ by more than a disturbance, so the probabilities are too
high, and this is a start: the packaged encoders are calibrated on real ones, and a map of importance deserves a
calibration of its own (``recalibration.py``).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels
from core.judgement.probability import fit_curve
from core.judgement.verdict import Calibration, Judgement, judge
from core.places import Neighborhood, Whereabouts

Scores = NDArray[np.float32]

FALSE_ACCEPTS = 0.10
"""The threshold lets at most this share of unknown places through."""

LOST_BY_MARGIN = 0.02
"""The margin turns at most this share of right answers into ambiguous ones."""

SMALLEST_DEVIATION = 1e-6
"""Of the background, in units of the score; frames that are all alike would have none."""


def second_look(pixels: Pixels) -> Pixels:
    """The same frame from a step aside (a shift by 8 %), darker, with less contrast; H x W x 3 uint8."""
    height, width = pixels.shape[:2]
    aside = pixels[:, round(0.08 * width) :]
    darker = cv2.convertScaleAbs(aside, alpha=0.75, beta=6)
    return np.asarray(cv2.resize(darker, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def calibrate(unknown: Scores, known: Scores, neighbours: int, source: str) -> Calibration:
    """Background, curve, threshold and margin from n frames in the order in which they were taken.

    Args:
        unknown: float32 [n, n], the scores of the frames among themselves.
        known: float32 [n, n], row i the second look of frame i against all frames.
        neighbours: frames up to so many places apart may show the same place.
        source: said of the calibration.

    Raises:
        ValueError: there are so few frames that all are neighbours of one another.
    """
    n = len(unknown)
    index = np.arange(n)
    apart = np.abs(index[:, None] - index[None, :]) > neighbours
    if not apart.any():
        raise ValueError(f"{n} frames are too few to calibrate on")
    unrelated = unknown[apart]
    start = Calibration(
        source=source,
        threshold=0.0,
        margin=0.0,
        background_mean=float(unrelated.mean()),
        background_deviation=max(SMALLEST_DEVIATION, float(unrelated.std())),
        decision="leading",
        frames=n,
    )
    same_place = Neighborhood(radius=0.0, frames=neighbours)
    strangers = [_judge(unknown[i], np.flatnonzero(apart[i]), start, same_place) for i in range(n) if apart[i].any()]
    decisions = np.sort([judgement.decision for judgement in strangers if judgement.decision is not None])
    # What equals the threshold passes, so it lies just above the last one to be kept out.
    threshold = float(np.nextafter(np.quantile(decisions, 1 - FALSE_ACCEPTS, method="higher"), np.inf))

    looks = [_judge(known[i], index, start, same_place) for i in range(n)]
    found = [bool(np.argmax(known[i]) == i) for i in range(n)]
    right = [look for look, hit in zip(looks, found, strict=True) if hit]
    margins = [r.margin for r in right if r.margin is not None and r.decision is not None and r.decision >= threshold]
    margin = max(0.0, float(np.quantile(margins, LOST_BY_MARGIN))) if margins else 0.0
    outcomes = [(decision, False) for decision in decisions.tolist()]
    outcomes += [(look.decision, hit) for look, hit in zip(looks, found, strict=True) if look.decision is not None]
    try:
        curve = fit_curve([decision for decision, _ in outcomes], [hit for _, hit in outcomes])
    except ValueError:  # frames that are all alike: no probability can be told
        curve = None
    return start.model_copy(update={"threshold": threshold, "margin": margin, "curve": curve})


def _judge(
    scores: Scores, places: NDArray[np.int64], calibration: Calibration, neighborhood: Neighborhood
) -> Judgement:
    """One query against a map of the frames ``places``."""
    order = places[np.argsort(-scores[places], kind="stable")]
    zeros = np.zeros(len(order), np.int64)
    frames = Whereabouts(zeros.astype(np.int8), np.zeros((len(order), 3)), zeros.astype(np.int32), order)
    return judge(scores[order], frames, calibration, neighborhood)
