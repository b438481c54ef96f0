"""The outcome of each query: its best match, whether that is right, and the rank of the first right one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.frames.traverses import Truth

Scores = NDArray[np.floating[Any]]
"""float32 from systems, or float64 from saved files."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of one query.

    retrieved: index of its best match, in the full list of references.
    rank: rank of its best true reference, from 1; None for a true negative.
    """

    retrieved: int
    score: float
    matched: bool
    rank: int | None


def judge_ranking(scores: Scores, retained: NDArray[np.int64], true: NDArray[np.int64]) -> Outcome:
    """The outcome of one query; of equal scores the lower reference index comes first.

    Args:
        scores: [R'], against each retained reference.
        retained: int64 [R'], their indices, ascending.
        true: int64, indices of the query's true references, retained or not.

    Raises:
        ValueError: there is no score, or one that is not finite.
    """
    if len(scores) == 0 or not np.isfinite(scores).all():
        raise ValueError("a ranking needs at least one score, all of them finite")
    best = int(np.argmax(scores))
    right = np.flatnonzero(np.isin(retained, true))
    rank = None
    if len(right):
        first = right[np.argmax(scores[right])]
        ahead = (scores > scores[first]) | ((scores == scores[first]) & (retained < retained[first]))
        rank = 1 + int(np.count_nonzero(ahead))
    return Outcome(int(retained[best]), float(scores[best]), rank == 1, rank)


def judge(scores: Scores, retained: NDArray[np.int64], truth: Truth, excluded: Truth | None = None) -> list[Outcome]:
    """The outcomes of all queries.

    Args:
        scores: [Q, R'].
        retained: int64 [R'], ascending.
        truth: of each query.
        excluded: of each query, the references that it is not matched against.

    Raises:
        ValueError: a query is matched against no reference, or a score is not finite.
    """
    if excluded is None:
        return [judge_ranking(row, retained, true) for row, true in zip(scores, truth, strict=True)]
    outcomes = []
    for row, true, left_out in zip(scores, truth, excluded, strict=True):
        matched = ~np.isin(retained, left_out)
        outcomes.append(judge_ranking(row[matched], retained[matched], true))
    return outcomes


def matched_scores(scores: Scores, retained: NDArray[np.int64], excluded: Truth | None) -> Scores:
    """The scores with -inf for the references that a query is not matched against; the array itself without any.

    Args:
        scores: [Q, R'].
        retained: int64 [R'].
        excluded: of each query.
    """
    if excluded is None:
        return scores
    matched = scores.copy()
    for row, left_out in zip(matched, excluded, strict=True):
        row[np.isin(retained, left_out)] = -np.inf
    return matched


def best_scores(outcomes: Sequence[Outcome]) -> NDArray[np.float64]:
    """The score of each query's best match, float64 [Q]."""
    return np.array([outcome.score for outcome in outcomes], np.float64)


def best_matched(outcomes: Sequence[Outcome]) -> NDArray[np.bool_]:
    """Whether each query's best match is right, bool [Q]."""
    return np.array([outcome.matched for outcome in outcomes], np.bool_)


def has_true_reference(outcomes: Sequence[Outcome]) -> NDArray[np.bool_]:
    """Whether each query has a retained true reference, bool [Q]; the others are true negatives."""
    return np.array([outcome.rank is not None for outcome in outcomes], np.bool_)


def answerable(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The outcomes of queries with a retained true reference; the others are true negatives."""
    return [outcome for outcome in outcomes if outcome.rank is not None]
