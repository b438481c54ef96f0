"""Geometric verification in a judgement: the third stage.

Verification (``core.geometry.verification``) counts the keypoints of a candidate that fit the query's, and rates how
surprising that is, the evidence e.  The share of inliers puts the candidates into their final order,

    score + SIMILARITY · similarity - AGREEMENT · agreement + INLIERS · inliers / min(keypoints of both),

in which the score is the sum of the first stage's similarity and the second's agreement: cells on a grid mislead where
the view has moved, and say little that keypoints do not say better.  Without a second stage the first keeps its say.
The value is the score of three stages, in the units of that of two,
and the evidence of the best match joins the log odds L of the first two stages in one probability,

    log odds = support · L + slope · ln(1 + e) + lead · (1 - u) · min(1, m / LEAD) + intercept,

with its lead m over the best rival in the final order, and the share u of other places that were imagined.  Evidence
needs no other place to be compared with, so it says in a map of one place what it says in a large one.  Places of one
scene share keypoints, though: one that fits better than all others is right far oftener than its evidence alone says.
Where two stages say next to nothing, as in a small map, the evidence decides.  A right match has none now and then, so
that the lack of it takes away at most as much as that is worth (``MOST_TAKEN``).  As keypoints are the same for every
encoder, and L is a log odds whatever the encoder's scores are, so are the numbers.

A rival takes away from the certainty of an answer as far as it fits as well.  Two places of one picture are so
``ambiguous``, however much evidence both have, and a best match that fits, of whose rivals none does, is ``recognized``
even if its lead in score is small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field

__all__ = ["INLIERS", "TERMS", "Geometry", "GeometryTerms", "final_gains", "final_order", "share_of_lead"]

Values = NDArray[np.float64]

SIMILARITY, AGREEMENT, INLIERS = 1.0, 0.5, 0.75
"""Chosen by recall@1 on tasks made of training photographs, where each kind of change, a view from elsewhere, night,
another drive, counts alike: they are within 0.004 of the best of a grid (``benchmarks.geometry.verification``)."""


@dataclass(frozen=True)
class Geometry:
    """The results of verification for the candidates of a ranking, in its order; NaN where one was not verified.

    evidence: float64 [n], at least 0.
    gain: float64 [n], what three stages add to the scores of two, also of places that were not verified; 0 as long as
        the best match alone was.

    Raises:
        ValueError: the arrays differ in shape.
    """

    evidence: Values
    gain: Values

    def __post_init__(self) -> None:
        if self.evidence.shape != self.gain.shape:
            raise ValueError("evidence and gain are of the same candidates")

    @property
    def best(self) -> float | None:
        """The evidence of the first candidate; None if it was not verified, or there is none."""
        return None if not len(self.evidence) or np.isnan(self.evidence[0]) else float(self.evidence[0])

    def take(self, positions: NDArray[np.int64]) -> Geometry:
        """The results of the candidates at some positions, int64 [m]."""
        return Geometry(self.evidence[positions], self.gain[positions])


class GeometryTerms(BaseModel):
    """How evidence joins the log odds of the first two stages (see the module)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    support: float = Field(ge=0, allow_inf_nan=False, description="Weight of the log odds of the first two stages.")
    slope: float = Field(gt=0, allow_inf_nan=False, description="Log odds gained by an evidence e times greater.")
    lead: float = Field(
        default=0.0,
        ge=0,
        allow_inf_nan=False,
        exclude_if=lambda lead: lead == 0,
        description="Log odds gained where the map has other places and none of them fits nearly as well.",
    )
    intercept: float = Field(allow_inf_nan=False, description="Log odds where nothing says anything.")

    def log_odds(self, two_stages: ArrayLike, evidence: ArrayLike, leads: ArrayLike) -> Values:
        """The log odds of three stages, all of one shape; lower than those of two by at most ``MOST_TAKEN``.

        Args:
            two_stages: the log odds of two.
            evidence: at least 0.
            leads: of :func:`share_of_lead`.
        """
        before, found = np.asarray(two_stages, np.float64), np.log1p(np.asarray(evidence, np.float64))
        gained = self.lead * np.asarray(leads, np.float64)
        three_stages = self.support * before + self.slope * found + gained + self.intercept
        return np.asarray(np.maximum(three_stages, before - MOST_TAKEN), np.float64)


MOST_TAKEN = 1.9
"""The most that the third stage takes away from the log odds of two, -ln of 0.066 / 0.423: how often right and wrong
best matches have no evidence on tasks made of training photographs, each kind of change counting alike.  From 1.5 to
2.5 the calibration error changes by at most 0.015 on all but one of these, nights cut on one side, where right ones
have no evidence oftener (0.173 to 0.195)."""

LEAD = 0.05
"""A lead over the best rival from here on says as much as one can."""

TERMS = GeometryTerms(support=0.5, slope=1.411, lead=2.0, intercept=-5.25)
"""The slope is fitted to maps of 1 to 100 frames of camvid, and of half of them (``python -m lab.training.map_sizes``),
the lead to halves of nights, hallways and a drive (``benchmarks.geometry.leads``).  These give an intercept of -5.04;
with -5.25 at most 0.03 of the strangers are recognized in maps of 1 to 30 places of corridor and lip6."""


def share_of_lead(margin: ArrayLike, imagined: ArrayLike = 0.0) -> Values:
    """The part that leads over rivals have of what a lead can say, float64 of any shape, in [0, 1].

    Args:
        margin: the leads in the final order; infinite without a rival, where there is none to lead, and minus infinity
            of a place that is not listed.
        imagined: the shares of other places that were imagined, for the map does not have them either.
    """
    leads = np.asarray(margin, np.float64)
    reached = np.where(np.isinf(leads), 0.0, np.clip(leads / LEAD, 0.0, 1.0))
    return np.asarray((1 - np.asarray(imagined, np.float64)) * reached, np.float64)


def final_gains(
    share: Values, similarity: NDArray[np.floating] | None = None, agreement: NDArray[np.floating] | None = None
) -> Values:
    """The gains of scores by the third stage, float64 [n].

    Args:
        share: float64 [n], inliers by the number of keypoints of the picture that has fewer, in [0, 1]; 0 of a place
            that was not verified.
        similarity, agreement: float [n], the parts of the scores; None where there is no second stage.
    """
    gains = INLIERS * share
    if similarity is None or agreement is None:
        return gains
    return np.asarray(gains + SIMILARITY * similarity - AGREEMENT * agreement, np.float64)


def final_order(scores: NDArray[np.floating], gains: Values) -> NDArray[np.int64]:
    """The order after verification, int64 [n], positions in the ranking of two stages, best first.

    Equal values keep their order.

    Args:
        scores: float [n], of two stages, changed by a prior if there is one.
        gains: float64 [n], see :func:`final_gains`.
    """
    return np.argsort(-(scores + gains), kind="stable")
