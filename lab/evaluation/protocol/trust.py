"""Whether a system knows when it is right: the probabilities of its best matches against their outcomes.

The decision value of a query is that of the verdicts (``core.judgement.verdict``): √(best score · lead over the best
other places), or the best score alone where scores fall below zero.  A curve turns it into a probability; each
block of queries is judged by a curve that was fitted on the other blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from core.judgement.calibration import FEWEST_OUTCOMES, blocks_of
from core.judgement.curves import auc_pr, auc_roc
from core.judgement.probability import fit_curve
from core.judgement.reliability import Reliability, Share, reliability, wilson
from core.judgement.verdict import TOP_PLACES
from lab.evaluation.protocol.outcomes import Outcome

SAME_PLACE = 3
"""References at most this number of frames from the best match are no rivals of it; the default of maps."""

BELIEVED = 0.95
"""Probability from which on an answer counts as believed."""

TOO_FEW = f"it takes {FEWEST_OUTCOMES} right and {FEWEST_OUTCOMES} wrong best matches to measure probabilities."
NO_ORDER = "right matches do not have higher scores than wrong ones in every part of the traverse."


class Doubt(BaseModel):
    """How well measures of doubt tell right best matches from wrong ones: areas under their precision and recall."""

    decision: float = Field(description="The decision value, from which the probability is.")
    score: float = Field(description="The score of the best match.")
    ratio: float = Field(description="That score over the one of the best other place.")
    spread: float = Field(
        description="The spread of where the best five references are, weighted by their scores (Zaffar et al., CVPR "
        "2024), by their numbers in the traverse."
    )


class Trust(BaseModel):
    """Figures of the probabilities of the best matches, cross-validated over blocks of queries."""

    doubt: Doubt
    auc_roc_right: float = Field(description="The chance that a right best match has a higher decision value.")
    reliability: Reliability
    believed_precision: Share = Field(description=f"Right ones, of the answers with a probability over {BELIEVED}.")
    believed_recall: Share = Field(description="Right and believed, of the queries with a true reference.")


def decisions(scores: NDArray[np.floating[Any]], retained: NDArray[np.int64]) -> NDArray[np.float64]:
    """The decision value of each query, float64 [Q].

    Args:
        scores: [Q, R'], higher is more alike.
        retained: int64 [R'], indices of the references.
    """
    best = scores.argmax(axis=1)
    top = scores.max(axis=1).astype(np.float64)
    others = np.where(np.abs(retained[None, :] - retained[best][:, None]) > SAME_PLACE, scores, -np.inf).astype(
        np.float64
    )
    count = min(TOP_PLACES, scores.shape[1])
    highest = -np.sort(-others, axis=1)[:, :count]
    there = np.isfinite(highest)
    mean = np.where(there, highest, 0).sum(axis=1) / np.maximum(1, there.sum(axis=1))
    if top.min() < 0 or mean.min() < 0:
        return top
    return np.asarray(np.sqrt(top * np.maximum(0, top - mean)), np.float64)


def doubt(
    scores: NDArray[np.floating[Any]],
    retained: NDArray[np.int64],
    right: NDArray[np.bool_],
    values: NDArray[np.float64],
) -> Doubt:
    """The areas of plain measures of doubt, beside that of the decision value.

    Args:
        scores: [Q, R']; retained: int64 [R'].
        right: bool [Q], whether the best match is.
        values: float64 [Q], the decision values.
    """
    best, top = scores.argmax(axis=1), scores.max(axis=1).astype(np.float64)
    apart = np.abs(retained[None, :] - retained[best][:, None]) > SAME_PLACE
    second = np.where(apart, scores, -np.inf).max(axis=1)
    ratio = np.where(np.isfinite(second), top / np.maximum(second, 1e-6), 1.0)
    first = np.argsort(-scores, axis=1, kind="stable")[:, :TOP_PLACES]
    weights = np.maximum(np.take_along_axis(scores, first, 1), 1e-6).astype(np.float64)
    where = retained[first].astype(np.float64)
    middle = np.average(where, axis=1, weights=weights)[:, None]
    spread = np.sqrt(np.average((where - middle) ** 2, axis=1, weights=weights))
    areas = (auc_pr(measure, right) for measure in (values, top, ratio, -spread))
    return Doubt(**dict(zip(Doubt.model_fields, areas, strict=True)))


def trust(
    scores: NDArray[np.floating[Any]], retained: NDArray[np.int64], outcomes: Sequence[Outcome]
) -> tuple[Trust | None, str | None]:
    """The figures of a run, or why there are none.

    Args:
        scores: [Q, R'].
        retained: int64 [R'].
        outcomes: one for each query, in the order in which they were taken.
    """
    right = np.array([outcome.matched for outcome in outcomes], np.bool_)
    if min(right.sum(), (~right).sum()) < FEWEST_OUTCOMES:
        return None, TOO_FEW
    values, probabilities = decisions(scores, retained), np.zeros(len(right))
    try:
        for block in blocks_of(np.arange(len(right))):
            probabilities[block] = fit_curve(values[~block], right[~block]).probabilities(values[block])
    except ValueError:
        return None, NO_ORDER
    believed = probabilities >= BELIEVED
    hits, known = int((believed & right).sum()), sum(outcome.rank is not None for outcome in outcomes)
    return Trust(
        doubt=doubt(scores, retained, right, values),
        auc_roc_right=auc_roc(values, right) or 0.0,
        reliability=reliability(probabilities, right),
        believed_precision=wilson(hits, int(believed.sum())),
        believed_recall=wilson(hits, known),
    ), None


def trust_figures(
    scores: NDArray[np.floating[Any]], retained: NDArray[np.int64], outcomes: Sequence[Outcome], notes: dict[str, str]
) -> dict[str, Any]:
    """The same as fields of an evaluation, whose notes say why a figure is missing."""
    found, why = trust(scores, retained, outcomes)
    if found is None:
        return {"notes": {**notes, "ece": why or TOO_FEW}}
    worth = found.reliability
    return {"trust": found, "ece": worth.ece, "brier": worth.brier, "brier_of_base_rate": worth.brier_of_base_rate}
