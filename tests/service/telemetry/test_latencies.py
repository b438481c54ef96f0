"""Quantiles of the last minutes: as close as the bins are, and old requests drop out."""

from __future__ import annotations

import numpy as np
import pytest

from service.telemetry.latencies import SECONDS, LatencyCounts, RecentLatencies

QUERY = ("POST", "/v1/maps/{map}/query")


class Clock:
    """A clock that is set by hand."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_quantiles_are_those_of_the_requests() -> None:
    durations = np.random.default_rng(3).lognormal(-4, 0.8, 5000)
    recent = RecentLatencies(Clock())
    for number, seconds in enumerate(durations.tolist()):
        recent.observe(*QUERY, 503 if number % 100 == 0 else 200, seconds)
    counts = recent.read()[QUERY]
    assert (counts.count, counts.errors, counts.longest) == (5000, 50, durations.max())
    for share in (0.01, 0.5, 0.9, 0.99, 1.0):
        assert counts.quantile(share) == pytest.approx(np.quantile(durations, share), rel=0.04)


def test_what_is_older_than_the_window_is_dropped() -> None:
    clock = Clock()
    recent = RecentLatencies(clock)
    recent.observe(*QUERY, 200, 1.0)
    clock.now += SECONDS / 2
    recent.observe(*QUERY, 200, 0.1)
    recent.observe("GET", "/livez", 0, 0.0)
    found = recent.read()
    assert list(found) == [QUERY, ("GET", "/livez")], "the most frequent one first"
    assert found[QUERY].count == 2 and found["GET", "/livez"].errors == 1
    clock.now += SECONDS / 2 + 10
    assert recent.read()[QUERY].count == 1
    clock.now += 10 * SECONDS
    assert recent.read() == {}


def test_nothing_took_no_time() -> None:
    assert LatencyCounts().quantile(0.5) == 0.0
