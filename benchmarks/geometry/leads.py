"""How much a lead over rivals says of a verified answer: fitted to tasks made of training photographs.

The log odds of three stages (``core.judgement.geometry``) have two numbers that say how far a lead is believed, its
weight and the constant beside it.  They make the outcomes on the tasks to fit on most likely, whose references are cut
in halves, so that half of the frames are strangers.  Support and slope are given; each kind of change counts alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from core.judgement.geometry import LEAD, TERMS
from core.judgement.trials import Trials
from core.judgement.verdict import Calibration

TrialsByKind = Mapping[str, Sequence[Trials]]

WALKS = ("night", "hall", "drive")
"""The kinds of tasks whose references are a traverse or fixed cameras.  Photographs that a program displaces have less
evidence at their true places than a second visit has, and numbers fitted to them let strangers pass."""

LEADS = (0.03, LEAD, 0.06)
"""Leads that may be enough."""


def loss(trials: Trials, calibration: Calibration, lead: float, intercept: float, enough: float = LEAD) -> float:
    """The mean of -ln of the probability of what was the case, by other numbers than those that are shipped.

    Args:
        trials: verified answers.
        calibration: by which they were judged.
        enough: from which lead on it says as much as one can.
    """
    terms = TERMS.model_copy(update={"lead": lead, "intercept": intercept})
    scaled = replace(trials, margin=trials.margin * (LEAD / enough))
    stated = scaled.probabilities(calibration.model_copy(update={"geometry": terms}))
    return float(-np.log(np.clip(np.where(trials.right, stated, 1 - stated), 1e-9, 1.0)).mean())


def mean_loss(
    by_kind: TrialsByKind, calibration: Calibration, lead: float, intercept: float, enough: float = LEAD
) -> float:
    """The loss over tasks; each kind counts alike, and in a kind each task."""
    kinds = [[loss(one, calibration, lead, intercept, enough) for one in some] for some in by_kind.values()]
    return float(np.mean([np.mean(losses) for losses in kinds]))


def fitted_lead(by_kind: TrialsByKind, calibration: Calibration, enough: float = LEAD) -> tuple[float, float, float]:
    """The lead's weight, the intercept, and the loss that they have."""
    start = [TERMS.lead, TERMS.intercept]
    found = minimize(lambda at: mean_loss(by_kind, calibration, at[0], at[1], enough), start, method="Nelder-Mead")
    return float(found.x[0]), float(found.x[1]), float(found.fun)


def lead_figures(by_kind: TrialsByKind, calibration: Calibration) -> dict[str, dict[str, float]]:
    """The numbers fitted to the verified answers of all kinds of WALKS, to all but one, and those that are shipped."""
    walks = {
        kind: [one.take(~np.isnan(one.evidence)) for one in some] for kind, some in by_kind.items() if kind in WALKS
    }
    sets = {"all": walks} | {
        f"without {left_out}": {kind: some for kind, some in walks.items() if kind != left_out} for left_out in walks
    }
    rows: dict[str, dict[str, float]] = {}
    for name, chosen in sets.items():
        for enough in LEADS if name == "all" else (LEAD,):
            lead, intercept, least = fitted_lead(chosen, calibration, enough)
            rows[f"{name}, {enough}"] = {"lead": lead, "intercept": intercept, "loss": least}
    shipped = mean_loss(walks, calibration, TERMS.lead, TERMS.intercept)
    none, constant = min((mean_loss(walks, calibration, 0.0, at), at) for at in np.arange(-7.0, -2.0, 0.1).tolist())
    return rows | {
        "shipped": {"lead": TERMS.lead, "intercept": TERMS.intercept, "loss": shipped},
        "no lead": {"lead": 0.0, "intercept": constant, "loss": none},
    }
