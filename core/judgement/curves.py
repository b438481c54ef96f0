"""Precision-recall and ROC curves of scored answers, and the areas under them.

Answers of equal score are accepted together, so a curve has one point for each different score.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Curve = tuple[NDArray[np.float64], NDArray[np.float64]]
"""x and y of the points, float64 [P] each, by rising x."""


def falling(scores: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The order of falling scores, int64 [n], and in it the last position of each different score, int64 [P]."""
    order = np.argsort(scores, kind="stable")[::-1]
    return order, np.flatnonzero(np.append(np.diff(scores[order]) != 0, True))


def pr_curve(scores: ArrayLike, right: ArrayLike) -> Curve | None:
    """Recall and precision of the answers accepted, as the threshold falls; None without a right answer.

    Recall is over right answers only.  The curve starts at recall 0 with precision 1.

    Args:
        scores: [n], of the answers.
        right: bool [n], whether each is right.
    """
    values, flags = np.asarray(scores, np.float64), np.asarray(right, np.bool_)
    if not flags.any():
        return None
    order, ends = falling(values)
    hits = np.cumsum(flags[order])[ends]
    return np.append(0.0, hits / flags.sum()), np.append(1.0, hits / (ends + 1))


def roc_curve(scores: ArrayLike, positive: ArrayLike) -> Curve | None:
    """False and true positive rate as the threshold falls; None unless there are both kinds.

    Args:
        scores: [n].
        positive: bool [n].
    """
    values, flags = np.asarray(scores, np.float64), np.asarray(positive, np.bool_)
    if flags.all() or not flags.any():
        return None
    order, ends = falling(values)
    hits = np.cumsum(flags[order])[ends]
    false, true = (ends + 1 - hits) / (~flags).sum(), hits / flags.sum()
    return np.append(0.0, false), np.append(0.0, true)


def auc_pr(scores: ArrayLike, right: ArrayLike) -> float:
    """The area under the precision-recall curve by the trapezoid rule; 0 without a right answer.

    This is scikit-learn's ``auc`` of ``precision_recall_curve``, as the thesis's authors compute it, and not average
    precision.  The arguments are those of ``pr_curve``.
    """
    curve = pr_curve(scores, right)
    return 0.0 if curve is None else float(np.trapezoid(curve[1], curve[0]))


def auc_roc(scores: ArrayLike, positive: ArrayLike) -> float | None:
    """The chance that a positive outscores a negative, where equal scores count half; None unless there are both.

    The arguments are those of ``roc_curve``.
    """
    curve = roc_curve(scores, positive)
    return None if curve is None else float(np.trapezoid(curve[1], curve[0]))
