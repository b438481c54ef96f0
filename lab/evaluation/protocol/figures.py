"""The figures of the thesis's protocol (sections 2.5, 3.4; method, section 9).

Every query is answered with its best match among the references.  A query without a true reference
(a *true negative*, made by leaving references out) has no right answer: its best match is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, Field

from core.judgement.curves import auc_pr, auc_roc
from lab.evaluation.protocol.outcomes import (
    Outcome,
    answerable,
    best_matched,
    best_scores,
    has_true_reference,
)
from lab.evaluation.protocol.thresholds import Thresholding, best_wrong_score, thresholdings
from lab.evaluation.protocol.trust import Trust

STAGES = ("forward", "regions", "vlad", "match")
DEPTHS = (1, 5, 10)

OneClass = Literal["all right", "none right"]

ALL_RIGHT = "every best match is right: the curve has one class only, and its area is 1 whatever the scores."
NONE_RIGHT = "no best match is right: there is no precision-recall curve, and 0 stands for its area."
NO_NEGATIVES = "every query has a retained true reference: true negatives come from leaving references out."
NO_POSITIVES = "no query has a retained true reference."


class Evaluation(BaseModel):
    """The figures of one encoder on one pair of traverses.

    A figure is null where it is not defined: AUC-ROC without negatives or without positives, recall
    without a query that has a true reference, the time of a stage that the encoder lacks.
    """

    encoder: str
    auc_pr: float
    one_class: OneClass | None = Field(
        description="Set where AUC-PR is meaningless because all matches are of one class."
    )
    auc_roc: float | None
    recall_at: dict[str, float | None]
    recall_at_full_precision: float | None
    extended_precision: float | None
    right: int = Field(description="Queries whose best match is right.")
    queries: int
    negatives: int | None = Field(description="Queries without a retained true reference.")
    references: int | None = Field(description="Those that were retained.")
    thresholds: list[Thresholding]
    bytes_per_place: int | None = None
    milliseconds: dict[str, float | None] = Field(description="Medians per query.")
    describe_milliseconds: float | None = Field(
        default=None, description="Median per query, all stages before matching, without decoding the image."
    )
    trained_on: str | None = None
    ece: float | None = Field(default=None, description="Expected calibration error of the probabilities in `trust`.")
    brier: float | None = Field(default=None, description="Their Brier score.")
    brier_of_base_rate: float | None = Field(
        default=None, description="That of always stating the share of right ones."
    )
    trust: Trust | None = Field(default=None, description="Whether the system knows when it is right.")
    notes: dict[str, str] = Field(description="By the name of a figure, why it is null or meaningless.")


def one_class(matched: ArrayLike) -> OneClass | None:
    """Which class matches have if they have only one, so that AUC-PR is meaningless; else None."""
    if np.all(matched):
        return "all right"
    return None if np.any(matched) else "none right"


def recall_at_k(outcomes: Sequence[Outcome], k: int) -> float | None:
    """Share of the queries with a true reference that have one among their ``k`` best matches."""
    ranks = [outcome.rank for outcome in outcomes if outcome.rank is not None]
    return sum(rank <= k for rank in ranks) / len(ranks) if ranks else None


def recall_at_full_precision(outcomes: Sequence[Outcome]) -> float | None:
    """Share of the queries with a true reference whose right match outscores every wrong match.

    The best match of a true negative is a wrong one as well.
    """
    positives = answerable(outcomes)
    if not positives:
        return None
    wrong = best_wrong_score(outcomes)
    return sum(outcome.matched and (wrong is None or outcome.score > wrong) for outcome in positives) / len(positives)


def extended_precision(outcomes: Sequence[Outcome]) -> float | None:
    """EP = (P_R0 + R_P100) / 2 of Ferrarini et al., RA-L 5(2), 2020.

    P_R0 is the precision at the lowest recall above zero: among the matches that score no less than
    the best right one.  R_P100 is ``recall_at_full_precision``.  It exceeds 0.5 only where no wrong
    match scores best.  0 without a right match; None without a query that has a true reference.
    """
    at_full_precision = recall_at_full_precision(outcomes)
    if at_full_precision is None:
        return None
    best_right = max((outcome.score for outcome in outcomes if outcome.matched), default=None)
    if best_right is None:
        return 0.0
    first = [outcome.matched for outcome in outcomes if outcome.score >= best_right]
    return (sum(first) / len(first) + at_full_precision) / 2


def summarize(
    encoder: str,
    outcomes: Sequence[Outcome],
    references: int,
    milliseconds: Mapping[str, float | None],
    *,
    describe_milliseconds: float | None = None,
    bytes_per_place: int | None = None,
    trained_on: str | None = None,
) -> Evaluation:
    """All figures of a run over ``references`` retained references; stages without a time are added as None."""
    scores, matched, positive = best_scores(outcomes), best_matched(outcomes), has_true_reference(outcomes)
    return Evaluation(
        encoder=encoder,
        auc_pr=auc_pr(scores, matched),
        one_class=one_class(matched),
        auc_roc=auc_roc(scores, positive),
        recall_at={str(depth): recall_at_k(outcomes, depth) for depth in DEPTHS},
        recall_at_full_precision=recall_at_full_precision(outcomes),
        extended_precision=extended_precision(outcomes),
        right=int(matched.sum()),
        queries=len(outcomes),
        negatives=int((~positive).sum()),
        references=references,
        thresholds=thresholdings(outcomes),
        bytes_per_place=bytes_per_place,
        milliseconds={**dict.fromkeys(STAGES), **milliseconds},
        describe_milliseconds=describe_milliseconds,
        trained_on=trained_on,
        notes=_notes(one_class(matched), positive),
    )


def _notes(one: OneClass | None, positive: NDArray[np.bool_]) -> dict[str, str]:
    notes = {}
    if one is not None:
        notes["auc_pr"] = ALL_RIGHT if one == "all right" else NONE_RIGHT
    if not positive.any():
        unknown = ("auc_roc", "recall_at", "recall_at_full_precision", "extended_precision")
        notes.update(dict.fromkeys(unknown, NO_POSITIVES))
    elif positive.all():
        notes["auc_roc"] = NO_NEGATIVES
    return notes
