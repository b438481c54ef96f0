"""How well an encoder recognizes one traverse by another: the thesis's protocol (sections 2.5, 3.4).

Every query is answered with its best match among the references.  A query without a true reference
(a *true negative*, made by leaving references out) has no right answer: its best match is wrong.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, Field

from core.traverses import Truth

if TYPE_CHECKING:
    from core.encoder import Encoding
    from core.preprocessing import Pixels

STAGES = ("forward", "regions", "vlad", "match")
DEPTHS = (1, 5, 10)


class Describer(Protocol):
    """What is evaluated: an encoder, or anything that describes frames by one vector."""

    @property
    def identity(self) -> str: ...

    def encode(self, pixels: Pixels) -> Encoding: ...

    def scores_from_inner_products(self, inner_products: NDArray[np.float32]) -> NDArray[np.float32]: ...


@dataclass(frozen=True)
class Outcome:
    """What became of one query.

    retrieved: index of its best match, in the full list of references.
    rank: place of its best true reference in the ranking, from 1; None for a true negative.
    """

    retrieved: int
    score: float
    matched: bool
    rank: int | None


class Evaluation(BaseModel):
    """The figures of one encoder on one pair of traverses.

    Null is what the data cannot tell: AUC-ROC without negatives or without positives, recall
    without a query that has a true reference, the time of a stage that the encoder lacks.
    """

    encoder: str
    auc_pr: float
    auc_roc: float | None
    recall_at: dict[str, float | None]
    recall_at_full_precision: float | None
    queries: int
    references: int = Field(description="Those that were kept.")
    milliseconds: dict[str, float | None] = Field(description="Medians per query.")


def judge_ranking(scores: NDArray[np.float32], kept: NDArray[np.int64], true: NDArray[np.int64]) -> Outcome:
    """The outcome of one query; of equal scores the lower reference index comes first.

    Args:
        scores: float32 [R'], against each kept reference.
        kept: int64 [R'], their indices, ascending.
        true: int64, indices of the query's true references, kept or not.

    Raises:
        ValueError: there is no score, or one that is not finite.
    """
    if len(scores) == 0 or not np.isfinite(scores).all():
        raise ValueError("a ranking needs at least one score, all of them finite")
    best = int(np.argmax(scores))
    right = np.flatnonzero(np.isin(kept, true))
    rank = None
    if len(right):
        first = right[np.argmax(scores[right])]
        ahead = (scores > scores[first]) | ((scores == scores[first]) & (kept < kept[first]))
        rank = 1 + int(np.count_nonzero(ahead))
    return Outcome(int(kept[best]), float(scores[best]), rank == 1, rank)


def auc_pr(scores: ArrayLike, matched: ArrayLike) -> float:
    """Area under the precision-recall curve of the best matches, by the trapezoid rule.

    Recall is over right matches only.  The curve starts at recall 0 with precision 1 and has one
    point for each different score: what scores alike is accepted together.  This is
    ``sklearn.metrics.auc`` of ``precision_recall_curve``, as the thesis's authors compute it, and
    not average precision.  Without a right match the area is 0, where that curve is undefined.

    Args:
        scores: [Q], of each query's best match.
        matched: bool [Q], whether it is right.
    """
    from sklearn.metrics import auc, precision_recall_curve  # takes a second; only evaluation needs it

    if not np.any(matched):
        return 0.0
    precision, recall, _ = precision_recall_curve(matched, scores)
    return float(auc(recall, precision))


def auc_roc(scores: ArrayLike, positive: ArrayLike) -> float | None:
    """The chance that a query with a true reference outscores one without; equal scores count half.

    Args:
        scores: [Q], of each query's best match, right or not.
        positive: bool [Q], whether the query has a kept true reference.

    Returns:
        None where all queries are positive, or none is.
    """
    from sklearn.metrics import roc_auc_score

    if np.all(positive) or not np.any(positive):
        return None
    return float(roc_auc_score(positive, scores))


def recall_at(outcomes: Sequence[Outcome], depth: int) -> float | None:
    """Share of the queries with a true reference that have one among their ``depth`` best matches."""
    ranks = [outcome.rank for outcome in outcomes if outcome.rank is not None]
    return sum(rank <= depth for rank in ranks) / len(ranks) if ranks else None


def recall_at_full_precision(outcomes: Sequence[Outcome]) -> float | None:
    """Share of the queries with a true reference whose right match outscores every wrong match.

    The best match of a true negative is a wrong one as well.
    """
    answerable = [outcome for outcome in outcomes if outcome.rank is not None]
    if not answerable:
        return None
    best_wrong = max((outcome.score for outcome in outcomes if not outcome.matched), default=-np.inf)
    return sum(outcome.matched and outcome.score > best_wrong for outcome in answerable) / len(answerable)


def summarize(
    encoder: str, outcomes: Sequence[Outcome], references: int, milliseconds: dict[str, float | None]
) -> Evaluation:
    """All figures of a run over ``references`` kept references."""
    scores = [outcome.score for outcome in outcomes]
    return Evaluation(
        encoder=encoder,
        auc_pr=auc_pr(scores, [outcome.matched for outcome in outcomes]),
        auc_roc=auc_roc(scores, [outcome.rank is not None for outcome in outcomes]),
        recall_at={str(depth): recall_at(outcomes, depth) for depth in DEPTHS},
        recall_at_full_precision=recall_at_full_precision(outcomes),
        queries=len(outcomes),
        references=references,
        milliseconds=milliseconds,
    )


def evaluate(
    describer: Describer,
    references: Sequence[Path],
    queries: Sequence[Path],
    truth: Truth,
    kept: NDArray[np.int64],
    load: Callable[[Path], Pixels],
    advance: Callable[[], None] = lambda: None,
) -> tuple[Evaluation, list[Outcome]]:
    """Encode the kept references, encode the queries, match, and count.

    Args:
        references: images of the whole reference traverse.
        truth: of each query, as indices into ``references``.
        kept: int64 [R'], indices of the references to match against, ascending.
        load: decodes an image; what it raises ends the run.
        advance: called after each image.

    Returns:
        The figures, and the outcome of each query in order.
    """
    known: NDArray[np.float32] | None = None
    for row, index in enumerate(kept):
        descriptor = describer.encode(load(references[index])).descriptor
        if known is None:
            known = np.empty((len(kept), len(descriptor)), np.float32)  # R' x D
        known[row] = descriptor
        advance()
    if known is None:
        raise ValueError("there is no reference to match against")

    outcomes: list[Outcome] = []
    times: dict[str, list[float]] = {stage: [] for stage in STAGES}
    for path, true in zip(queries, truth, strict=True):
        encoding = describer.encode(load(path))
        began = time.perf_counter()
        scores = describer.scores_from_inner_products(known @ encoding.descriptor)
        spent = {**encoding.milliseconds, "match": 1e3 * (time.perf_counter() - began)}
        for stage in STAGES:
            if stage in spent:
                times[stage].append(spent[stage])
        outcomes.append(judge_ranking(scores, kept, true))
        advance()
    medians = {stage: float(np.median(spent)) if spent else None for stage, spent in times.items()}
    return summarize(describer.identity, outcomes, len(kept), medians), outcomes


def results_csv(outcomes: Sequence[Outcome]) -> str:
    """One CSV row per query: ``query,retrieved,score,matched`` (matched is 1 or 0)."""
    rows = ["query,retrieved,score,matched"]
    for query, outcome in enumerate(outcomes):
        rows.append(f"{query},{outcome.retrieved},{outcome.score:.9g},{int(outcome.matched)}")
    return "\n".join(rows) + "\n"
