"""What one frame says about every place: log likelihood ratios from the scores of a search.

A score means little by itself, so it is held against two others of the same frame: the mean score of listed
places that cannot be the best one's place (a place that scores so is no likelier than any that was not listed)
and the *believable* score, at which the single-frame verdict would just accept a best match.  Between them
evidence grows in proportion, beyond them faster; a place at the believable score gains STRENGTH.  Places outside
the list share the background's 0: a compact index returns the best hundred or so and no more, and an encoder with a
second stage compares only its candidates in full.

Consecutive frames are not independent (they show the same thing, so they are mistaken about the same thing),
which is why STRENGTH is far below what the odds of one frame alone would be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.judgement.verdict import FEWEST_PLACES, TOP_PLACES, Calibration, filled_up
from core.places import Neighborhood, Whereabouts

LISTED = 100
"""Places that speak for themselves where there is no second stage; every index returns so many."""

STRENGTH = 0.7
"""Log likelihood ratio of a place at the believable score against one in the background."""

CLEARNESS = 1.0
"""What is gained beside it for each such step above the believable score: mistakes are rarely as clear as that."""

STRONGEST = 6.0
"""No frame says more of a place, whatever it scores."""

UNKNOWN = 0.8
"""What a frame says of not being in the map, as a share of STRENGTH: a place that scores better, on the average of
the frames, is believed before it."""


@dataclass(frozen=True)
class Evidence:
    """What one frame says; the background's log likelihood is 0.

    rows: int64 [k], rows of the map.
    gains: float32 [k], over 0: log likelihood ratio of those places to the background.
    unknown: log likelihood ratio of not being in the map to the background.
    """

    rows: NDArray[np.int64]
    gains: NDArray[np.float32]
    unknown: float

    def tempered(self, weight: float) -> Evidence:
        """With every log likelihood ``weight`` times as large."""
        return Evidence(self.rows, self.gains * np.float32(weight), self.unknown * weight)


NOTHING = Evidence(np.empty(0, np.int64), np.empty(0, np.float32), 0.0)
"""A frame that says nothing: one without regions, or one in an empty map."""


def evidence(
    rows: NDArray[np.int64],
    scores: NDArray[np.float32],
    whereabouts: Whereabouts,
    calibration: Calibration,
    neighborhood: Neighborhood,
    examined: NDArray[np.bool_] | None = None,
) -> Evidence:
    """What a search says of the places of a map.

    Args:
        rows, scores: int64 and float32 [n], best first, as ``judge`` gets them; the best 100 suffice.
        whereabouts: of the same n places.
        calibration: that by which the frame is judged.
        examined: bool [n], which of them the encoder's second stage has examined; None or none: it has no such stage.
    """
    if len(rows) == 0:
        return NOTHING
    second_stage = examined is not None and bool(examined.any())
    listed = np.flatnonzero(examined) if examined is not None and second_stage else np.arange(min(len(rows), LISTED))
    values = scores[listed].astype(np.float64)
    rest = values[~whereabouts.take(listed).near(0, neighborhood)]
    ordinary, believable = believable_score(rest, calibration, second_stage)
    shares = (values - ordinary) / (believable - ordinary)
    gains = np.minimum(STRENGTH * shares + CLEARNESS * np.maximum(shares - 1, 0), STRONGEST).astype(np.float32)
    gaining = gains > 0
    return Evidence(rows[listed][gaining], gains[gaining], STRENGTH * UNKNOWN)


def believable_score(rest: NDArray[np.float64], calibration: Calibration, second_stage: bool) -> tuple[float, float]:
    """The mean score of the rest, and the least score at which a best match would be believed beside that rest.

    The second solves the verdict's own rule for the score: threshold² = s · (s - top), where top is the mean of the
    best few of the rest, or in older calibrations of one stage threshold = (s - top) / spread.

    Args:
        rest: float64 [n], best first: listed places that are not the best one's place.
    """
    leads = second_stage or calibration.decision == "leading"
    scores = filled_up(rest.astype(np.float32), TOP_PLACES if leads else FEWEST_PLACES, calibration)
    ordinary, top = float(scores.mean()), float(scores[:TOP_PLACES].mean())
    spread = max(float(scores.std()), 0.1 * calibration.background_deviation)
    if leads:
        positive = max(top, 0.0)
        believable = (positive + np.sqrt(positive**2 + 4 * max(calibration.threshold, 0.0) ** 2)) / 2
    else:
        believable = top + calibration.threshold * spread
    return ordinary, float(max(believable, ordinary + 0.5 * spread))
