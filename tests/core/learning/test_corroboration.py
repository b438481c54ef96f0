"""Proposals that may be taken without a person: two runs agree, or keypoints do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from numpy.typing import NDArray

from core.judgement.verdict import Calibration
from core.learning import PendingProposal, Proposal, Witness, corroborated
from tests.core.learning.runs import way

CALIBRATION = Calibration(source="made up", threshold=0.2, margin=0.02, background_mean=0.05, background_deviation=0.03)
GRAPH = way(60)
TUESDAY = [*range(10, 40, 2)]
LATE = Witness("A", datetime(2026, 11, 20, 23, 50, tzinfo=UTC))


def pending(row: int, run: str, geometry: float | None = None, source: Witness | None = None) -> PendingProposal:
    proposal = Proposal(row, row, 0.99, (row - 1, row + 1), 0.5, 0.5, geometry, "it was dark")
    return PendingProposal(proposal, run, source or replace(LATE, robot=run))


class Scores:
    """Frames of one place score 0.6, of others 0.1, but for the pairs that are given."""

    def __init__(self, waiting: Sequence[PendingProposal], pairs: dict[tuple[int, int], float] | None = None) -> None:
        self.waiting, self.pairs = waiting, pairs or {}

    def __call__(self, number: int, others: Sequence[int]) -> NDArray[np.float32]:
        rows = [one.proposal.row for one in self.waiting]
        return np.array(
            [self.pairs.get((number, other), 0.6 if rows[number] == rows[other] else 0.1) for other in others],
            np.float32,
        )


def taken(waiting: Sequence[PendingProposal], pairs: dict[tuple[int, int], float] | None = None) -> dict[int, str]:
    return dict(corroborated(waiting, GRAPH, CALIBRATION, Scores(waiting, pairs)))


def test_two_runs_that_show_the_same_are_taken() -> None:
    waiting = [pending(20, "monday"), *(pending(row, "tuesday") for row in TUESDAY)]
    assert taken(waiting) == {0: "runs", 1 + TUESDAY.index(20): "runs"}


def test_one_run_alone_is_not() -> None:
    assert taken([pending(row, "tuesday") for row in TUESDAY]) == {}


@pytest.mark.parametrize(("hours", "count"), [(1 / 3, 0), (11.9, 0), (12, 2)])
def test_two_runs_of_one_robot_are_one_witness_until_half_a_day_lies_between(hours: float, count: int) -> None:
    after = replace(LATE, began=LATE.began + timedelta(hours=hours))
    waiting = [pending(20, "first", source=LATE), *(pending(row, "second", source=after) for row in TUESDAY)]
    assert len(taken(waiting)) == count


@pytest.mark.parametrize("elsewhere", [0.59, 0.7])
def test_a_frame_that_is_as_much_like_other_places_of_that_night_is_not(elsewhere: float) -> None:
    waiting = [pending(20, "monday"), *(pending(row, "tuesday") for row in TUESDAY)]
    far = 1 + TUESDAY.index(36)
    assert 0 not in taken(waiting, {(0, far): elsewhere})


def test_keypoints_that_fit_a_recognized_frame_are_enough() -> None:
    assert taken([pending(20, "monday", 80.0), pending(30, "monday", 30.0)]) == {0: "geometry"}


def test_a_place_that_is_gone_takes_nothing() -> None:
    assert taken([pending(999, "monday", 80.0)]) == {}
