"""What histories of places tell: days are evidence, frames are not, and chance is told from change."""

from __future__ import annotations

from datetime import date, timedelta

import numpy as np
import pytest
from scipy.stats import hypergeom

from core.upkeep.histories import (
    AnswerHistory,
    PlacePeriod,
    QuietStretch,
    by_chance,
    changed_places,
    quiet_stretches,
    worse_places,
)

TODAY = date(2026, 11, 26)


def ago(days: int) -> date:
    return TODAY - timedelta(days=days)


def answered(recognized: int, best: int = 10) -> PlacePeriod:
    return PlacePeriod(best=best, recognized=recognized)


def passed(frames: int, missed: int, inliers: int | None = None) -> PlacePeriod:
    verified = 0 if inliers is None else frames
    return PlacePeriod(best=frames, passed=frames, missed=missed, verified=verified, inliers=verified * (inliers or 0))


EARLIER = PlacePeriod(best=500, recognized=480, days=40, good=39)


def test_chance_is_that_of_the_hypergeometric_distribution() -> None:
    for good, days, good_before, days_before in ((0, 5, 39, 40), (3, 7, 10, 12), (7, 7, 3, 20)):
        expected = hypergeom(days + days_before, good + good_before, days).cdf(good)
        assert by_chance(good, days, good_before, days_before) == pytest.approx(expected)


def test_a_place_with_bad_days_after_many_good_ones_gets_worse() -> None:
    bad = {ago(day): answered(1) for day in range(5)}
    (found,) = worse_places({"p1": AnswerHistory(bad, earlier=EARLIER)}, TODAY)
    assert (found.place, found.recent.days, found.recent.good) == ("p1", 5, 0)
    assert (found.before.days, found.before.good) == (40, 39) and found.chance < 1e-4


def test_thousands_of_frames_of_one_day_are_one_day() -> None:
    stood = AnswerHistory({ago(0): answered(0, 100_000)}, earlier=PlacePeriod(best=50, recognized=50, days=5, good=5))
    assert worse_places({"p1": stood}, TODAY) == []


def test_days_before_the_last_seven_are_what_the_last_ones_are_compared_with() -> None:
    days = {ago(day): answered(0 if day < 7 else 10) for day in range(14)}
    (found,) = worse_places({"p1": AnswerHistory(days)}, TODAY)
    assert (found.recent.days, found.before.days) == (7, 7)


def test_frames_of_runs_count_before_best_matches() -> None:
    """A place that others are taken for is no worse, while runs that pass it recognize it."""
    hub = {ago(day): answered(0, 50) + passed(4, 0) for day in range(7)}
    assert worse_places({"p1": AnswerHistory(hub, earlier=EARLIER)}, TODAY) == []


def test_few_of_many_unchanged_places_are_said_to_get_worse() -> None:
    random = np.random.default_rng(0)
    places = {}
    for number in range(2000):
        share = random.uniform(0.5, 1)
        before = int(random.binomial(40, share))
        days = {ago(day): answered(10 * int(random.random() < share)) for day in range(7)}
        places[f"p{number}"] = AnswerHistory(days, earlier=PlacePeriod(days=40, good=before))
    assert len(worse_places(places, TODAY)) <= 2


def test_a_place_that_runs_pass_while_frames_fail_has_changed() -> None:
    usual = AnswerHistory({ago(2): passed(20, 0, 60)})
    histories = {"p1": AnswerHistory({ago(day): passed(5, 4, 6) for day in (0, 3)}), "p2": usual, "p3": usual}
    (found,) = changed_places(histories, TODAY)
    assert found.place == "p1" and (found.recent.passed, found.recent.missed) == (10, 8)
    assert found.usual_inliers == pytest.approx((10 * 6 + 40 * 60) / 50)


@pytest.mark.parametrize(
    "days",
    [
        {ago(0): passed(50, 50, 6)},  # a single day
        {ago(0): passed(1, 1, 6), ago(1): passed(1, 1, 6)},  # too few frames
        {ago(0): passed(5, 2, 6), ago(1): passed(5, 2, 6)},  # most were recognized
        {ago(0): passed(5, 5, 58), ago(1): passed(5, 5, 58)},  # geometry finds as much as ever
        {ago(9): passed(5, 5, 6), ago(8): passed(5, 5, 6)},  # long ago
    ],
)
def test_a_place_has_not_changed_without_days_frames_misses_and_few_inliers(days: dict[date, PlacePeriod]) -> None:
    usual = AnswerHistory({ago(2): passed(200, 0, 60)})
    assert changed_places({"p1": AnswerHistory(days), "p2": usual}, TODAY) == []


def test_a_stretch_is_quiet_if_robots_drive_elsewhere_only() -> None:
    seen = [ago(1), ago(30), ago(45), None, ago(60), ago(0), ago(40), ago(2)]
    assert quiet_stretches(seen, TODAY, TODAY) == [QuietStretch(1, 4, ago(30))]
    assert quiet_stretches(seen, ago(8), TODAY) == [], "nobody drives anywhere"
    assert quiet_stretches([None] * 5 + [ago(0)], TODAY, TODAY) == [], "nobody ever drove there"
    assert quiet_stretches([ago(29)] * 2 + [ago(0)], TODAY, TODAY) == [], "too short"


def test_last_seen_is_the_last_day_or_the_end_of_the_last_week() -> None:
    one = PlacePeriod(best=1)
    assert AnswerHistory({ago(3): one, ago(5): one}, {ago(40): one}).last_seen == ago(3)
    assert AnswerHistory(weeks={ago(40): one, ago(33): one}).last_seen == ago(27)
    assert AnswerHistory(earlier=one).last_seen is None
