"""Thresholds that reject matches of low score, and the counts of right and wrong answers (thesis, 3.4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import BaseModel, Field

from lab.evaluation.protocol.outcomes import Outcome

Rule = Literal["mean_of_negatives", "full_precision"]


class Counts(BaseModel):
    """Numbers of queries by outcome."""

    true_positives: int = Field(description="Accepted, and the match is right.")
    false_positives: int = Field(description="Accepted, and the match is wrong.")
    false_negatives: int = Field(description="Rejected although a true reference is retained.")
    true_negatives: int = Field(description="Rejected, and no true reference is retained.")


class Thresholding(BaseModel):
    """The effect of one threshold; a match is accepted when it scores above it.

    ``before`` is the left column of the thesis's Fig. 3.17: no match is rejected yet, and the queries
    without a true reference are counted as the true negatives that a perfect threshold would make.
    """

    rule: Rule
    threshold: float
    before: Counts
    after: Counts


def count_before(outcomes: Sequence[Outcome]) -> Counts:
    """The queries before any threshold, as Fig. 3.17 sorts them."""
    negatives = sum(outcome.rank is None for outcome in outcomes)
    right = sum(outcome.matched for outcome in outcomes)
    return Counts(
        true_positives=right,
        false_positives=len(outcomes) - negatives - right,
        false_negatives=0,
        true_negatives=negatives,
    )


def count_after(outcomes: Sequence[Outcome], threshold: float) -> Counts:
    """The queries when matches that do not score above ``threshold`` are rejected (method, section 8)."""
    accepted = [outcome for outcome in outcomes if outcome.score > threshold]
    rejected = [outcome for outcome in outcomes if not outcome.score > threshold]
    return Counts(
        true_positives=sum(outcome.matched for outcome in accepted),
        false_positives=sum(not outcome.matched for outcome in accepted),
        false_negatives=sum(outcome.rank is not None for outcome in rejected),
        true_negatives=sum(outcome.rank is None for outcome in rejected),
    )


def mean_of_negatives(outcomes: Sequence[Outcome]) -> float | None:
    """The thesis's threshold: the mean score of the known true negatives; None without any.

    The thesis averages over several data sets; this is the mean of one.
    """
    scores = [outcome.score for outcome in outcomes if outcome.rank is None]
    return float(np.mean(scores)) if scores else None


def best_wrong_score(outcomes: Sequence[Outcome]) -> float | None:
    """The lowest threshold above which every match is right; None where none is wrong."""
    return max((outcome.score for outcome in outcomes if not outcome.matched), default=None)


def thresholdings(outcomes: Sequence[Outcome]) -> list[Thresholding]:
    """The effects of the two thresholds that these outcomes define."""
    chosen: list[tuple[Rule, float | None]] = [
        ("mean_of_negatives", mean_of_negatives(outcomes)),
        ("full_precision", best_wrong_score(outcomes)),
    ]
    return [
        Thresholding(
            rule=rule, threshold=threshold, before=count_before(outcomes), after=count_after(outcomes, threshold)
        )
        for rule, threshold in chosen
        if threshold is not None
    ]
