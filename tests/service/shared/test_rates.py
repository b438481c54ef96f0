"""Limits of requests that hold over services."""

from __future__ import annotations

from pathlib import Path

import pytest

from core.errors import StorageFailure
from service.shared.database import SharedDatabase
from service.shared.rates import SharedBuckets
from tests.service.server import assert_problem
from tests.service.shared.postgres import Postgres
from tests.service.shared.services import MAP, two_services

pytestmark = [pytest.mark.cluster]

RATE = 0.01
"""So slow that no test waits for a token."""


def test_what_one_lets_through_the_other_holds_back(database: SharedDatabase) -> None:
    one, other = (SharedBuckets(database, "request", RATE, 10) for _ in range(2))
    assert [one.take("ann") for _ in range(10)] == [0.0] * 10 and one.take("ann") > 0
    one.exchange()
    assert one.take("ann") == pytest.approx(1 / RATE, rel=0.2)
    assert other.take("ann") == 0.0, "it has not heard of it yet"
    other.exchange()
    assert other.take("ann") == pytest.approx(2 / RATE, rel=0.2), "what was too much is held back"
    assert other.take("bob") == 0.0
    for _ in range(3):  # what is taken meanwhile counts, too, and nothing counts twice
        other.take("bob")
        other.exchange()
    one.take("bob")
    one.exchange()
    assert [one.take("bob") for _ in range(6)] == [0.0] * 5 + [pytest.approx(1 / RATE, rel=0.2)]


def test_without_the_database_each_keeps_to_it_alone() -> None:
    alone = SharedBuckets(SharedDatabase("postgresql://placerec@127.0.0.1:9/postgres"), "request", RATE, 3)
    assert [alone.take("ann") for _ in range(4)] == [0.0] * 3 + [pytest.approx(1 / RATE, rel=0.2)]
    with pytest.raises(StorageFailure):
        alone.exchange()
    assert alone._taken == {"ann": 3}, "it is told later"


def test_two_services(prepared: Path, tmp_path: Path, postgres: Postgres, database: SharedDatabase) -> None:
    limits = {"rate_per_key": 0.01, "rate_burst": 20}
    with two_services(prepared, tmp_path, postgres.address, limits) as both:
        answers = [both[number % 2].client.get(f"/v1/maps/{MAP}") for number in range(60)]
    refused = [answer for answer in answers if answer.status_code != 200]
    assert_problem(refused[-1], 429, "rate-exceeded")
    assert 20 <= len(answers) - len(refused) <= 40, "at most the bursts of both"
