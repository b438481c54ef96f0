"""Formulae of queues against each other and against values that follow by hand."""

from __future__ import annotations

import math

import pytest

from benchmarks.cluster.queues import closed, servers_for, waiting


def test_one_server_is_the_textbook_queue() -> None:
    # M/M/1 at half load: as long in the queue as in service.
    assert waiting(0.5, 1.0, 1) == pytest.approx(1.0)
    # M/M/2 at half load: Erlang's C is 1/3.
    assert waiting(1.0, 1.0, 2) == pytest.approx(1 / 3)
    assert math.isinf(waiting(2.0, 1.0, 2))


def test_no_more_servers_than_are_needed() -> None:
    for arrivals in (0.3, 7.0, 950.0):
        needed = servers_for(arrivals, 1.0, 0.1)
        assert waiting(arrivals, 1.0, needed) <= 0.1
        assert needed == 1 or waiting(arrivals, 1.0, needed - 1) > 0.1


def test_robots_that_wait_for_their_answers() -> None:
    assert closed(0.01, 2, 1) == pytest.approx((100.0, 0.01))
    assert closed(0.01, 2, 2) == pytest.approx((200.0, 0.01))
    rate, seconds = closed(0.01, 2, 64)
    assert rate == pytest.approx(200.0, rel=1e-6) and seconds == pytest.approx(0.32, rel=1e-6)
    rate, seconds = closed(0.01, 2, 50, thinking=1.0)
    assert rate == pytest.approx(50 / (1.0 + seconds)) and 0.01 < seconds < 0.0125
