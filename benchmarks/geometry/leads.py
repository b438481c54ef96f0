"""How much a lead over rivals says of a verified answer: fitted to tasks made of training photographs.

The log odds of three stages (``core.judgement.geometry``) have two numbers that say how far a lead is believed, its
weight and the constant beside it.  They make the outcomes on the tasks to fit on most likely, whose references are cut
in halves, so that half of the frames are strangers.  Support and slope are given; each kind of change counts alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from core.judgement.geometry import LEAD, TERMS, share_of_lead
from core.judgement.probability import sigmoid
from core.judgement.verdict import Calibration, Judgement, log_odds_of, share_of_leads

Array = NDArray[np.float64]

WALKS = ("night", "hall", "drive")
"""The kinds of tasks whose references are a traverse or fixed cameras.  Photographs that a program displaces have less
evidence at their true places than a second visit has, and numbers fitted to them let strangers pass."""

LEADS = (0.03, LEAD, 0.06)
"""Leads that may be enough."""


@dataclass(frozen=True)
class VerifiedAnswers:
    """The n verified answers of a task, float64 [n] and bool [n].

    odds: log odds of three stages without a lead's part and without the constant.
    imagined: the share of other places that were imagined.
    margin: the lead over the best rival; infinite without one.
    left: the part of the probability that a rival under the margin leaves.
    right: whether the best match is.
    """

    odds: Array
    imagined: Array
    margin: Array
    left: Array
    right: NDArray[np.bool_]

    @classmethod
    def of(cls, judged: Sequence[tuple[Judgement, bool]], calibration: Calibration) -> VerifiedAnswers:
        """Of judgements, and whether their best matches are right; those that were not verified are left out."""
        bare = calibration.model_copy(update={"geometry": TERMS.model_copy(update={"lead": 0.0, "intercept": 0.0})})
        rows = []
        for one, right in judged:
            if one.evidence is not None and one.decision is not None:
                before = log_odds_of(one.decision, one.lead, bare, one.imagined, one.evidence)
                rows.append((float(np.asarray(before)), one.imagined, one.lead, right))
        odds, imagined, margin, rights = np.array(rows, np.float64).reshape(-1, 4).T
        return cls(odds, imagined, margin, share_of_leads(margin, calibration), rights > 0)

    def probabilities(self, weight: float, constant: float, enough: float = LEAD) -> Array:
        """The probabilities by other numbers than those that are shipped, float64 [n]."""
        shares = share_of_lead(self.margin * LEAD / enough, self.imagined)
        return np.asarray(sigmoid(self.odds + weight * shares + constant) * self.left, np.float64)

    def loss(self, weight: float, constant: float, enough: float = LEAD) -> float:
        """The mean of -ln of the probability of what was the case."""
        stated = np.clip(self.probabilities(weight, constant, enough), 1e-9, 1 - 1e-9)
        return float(-np.log(np.where(self.right, stated, 1 - stated)).mean())


def mean_loss(by_kind: Mapping[str, Sequence[VerifiedAnswers]], weight: float, constant: float, enough: float) -> float:
    """The loss over tasks; each kind counts alike, and in a kind each task."""
    return float(np.mean([np.mean([one.loss(weight, constant, enough) for one in some]) for some in by_kind.values()]))


def fitted_lead(by_kind: Mapping[str, Sequence[VerifiedAnswers]], enough: float = LEAD) -> tuple[float, float, float]:
    """The weight of a lead, the constant, and the loss that they have."""
    start = [TERMS.lead, TERMS.intercept]
    found = minimize(lambda at: mean_loss(by_kind, at[0], at[1], enough), start, method="Nelder-Mead")
    return float(found.x[0]), float(found.x[1]), float(found.fun)


def lead_figures(by_kind: Mapping[str, Sequence[VerifiedAnswers]]) -> dict[str, dict[str, float]]:
    """The numbers fitted to all kinds of WALKS, to all but one, and those that are shipped."""
    walks = {kind: some for kind, some in by_kind.items() if kind in WALKS}
    sets = {"all": walks} | {
        f"without {left_out}": {kind: some for kind, some in walks.items() if kind != left_out} for left_out in walks
    }
    rows: dict[str, dict[str, float]] = {}
    for name, chosen in sets.items():
        for enough in LEADS if name == "all" else (LEAD,):
            weight, constant, loss = fitted_lead(chosen, enough)
            rows[f"{name}, {enough}"] = {"weight": weight, "constant": constant, "loss": loss}
    shipped = mean_loss(walks, TERMS.lead, TERMS.intercept, LEAD)
    none = min(mean_loss(walks, 0.0, constant, LEAD) for constant in np.arange(-7.0, -2.0, 0.1).tolist())
    return rows | {
        "shipped": {"weight": TERMS.lead, "constant": TERMS.intercept, "loss": shipped},
        "no lead, its best constant": {"weight": 0.0, "constant": float("nan"), "loss": none},
    }
