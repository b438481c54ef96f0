"""A drift is told when it is there, and chance is not told as one."""

from __future__ import annotations

from datetime import date, timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.judgement.verdict import Verdict
from core.upkeep.drift import SCORE_BINS, Week, score_trend, trend, unknown_trend

MONDAY = date(2026, 1, 5)


def weeks(means: list[float], unknown: list[float], queries: int = 200, seed: int = 0) -> list[Week]:
    random = np.random.default_rng(seed)
    made = []
    for number, (mean, rate) in enumerate(zip(means, unknown, strict=True)):
        monday = MONDAY + timedelta(weeks=number)
        week = Week(monday)
        for score in random.normal(mean, 0.1, queries):
            verdict: Verdict = "unknown" if random.random() < rate else "recognized"
            week += Week.of(monday, verdict, float(score), 2 * float(score))
        made.append(week)
    return made


def test_a_drift_is_found() -> None:
    found = weeks([0.5 - 0.02 * n for n in range(10)], [0.1 + 0.05 * n for n in range(10)])
    falling, rising = score_trend(found), unknown_trend(found)
    assert falling is not None and falling.significant and falling.per_week == pytest.approx(-0.02, abs=0.003)
    assert rising is not None and rising.significant and rising.per_week == pytest.approx(0.05, abs=0.01)


def test_chance_is_rarely_reported_as_drift() -> None:
    told = 0
    for seed in range(60):
        found = weeks([0.5] * 12, [0.2] * 12, 60, seed)
        for trend_ in (score_trend(found), unknown_trend(found)):
            assert trend_ is not None
            told += trend_.significant
    assert told <= 3


def test_weeks_that_differ_among_themselves_are_no_drift() -> None:
    means = [0.5, 0.4, 0.55, 0.42, 0.52, 0.41, 0.5, 0.44]
    found = score_trend(weeks(means, [0.1] * 8, 2000))
    assert found is not None and not found.significant


def test_a_few_weeks_or_queries_make_no_trend() -> None:
    assert score_trend(weeks([0.5] * 3, [0.1] * 3)) is None
    assert unknown_trend(weeks([0.5] * 8, [0.1] * 8, 5)) is None
    assert trend([1.0] * 5, [0.1] * 5, [1.0] * 5) is None, "all of one moment"


def test_a_week_without_any_unknown_does_not_rule() -> None:
    found = unknown_trend(weeks([0.5] * 6, [0.0] * 6))
    assert found is not None and not found.significant


verdicts = st.sampled_from(["recognized", "ambiguous", "unknown"])
answers = st.tuples(verdicts, st.none() | st.floats(-1, 2, width=32), st.none() | st.floats(0, 8, width=32))


@given(st.lists(answers, max_size=30), st.integers(0, 30))
def test_counting_in_parts_is_counting(found: list[tuple[Verdict, float | None, float | None]], cut: int) -> None:
    def counted(part: list[tuple[Verdict, float | None, float | None]]) -> Week:
        return sum((Week.of(MONDAY, *answer) for answer in part), Week(MONDAY))

    whole, parts = counted(found), counted(found[:cut]) + counted(found[cut:])
    assert whole.queries == len(found) == parts.queries
    assert whole.bins == parts.bins and sum(whole.bins) == whole.compared and len(whole.bins) == SCORE_BINS
    assert whole.score == pytest.approx(parts.score)
    assert (whole.mean_score() is None) == (whole.compared == 0)
    if whole.queries:
        rate = whole.unknown_rate()
        assert rate is not None and 0 <= rate <= 1


def test_two_weeks_are_not_one() -> None:
    with pytest.raises(ValueError, match="different weeks"):
        Week(MONDAY) + Week(MONDAY + timedelta(weeks=1))
