"""Limits of requests a second: buckets, whose requests are counted together, and the answer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import pytest
from sqlalchemy import column, select, table

from core.errors import StorageFailure
from core.ledger import Statement
from service.access.keys import Keys
from service.access.rates import FAILURE_BURST, FAILURES_PER_SECOND, MOST_CALLERS, Buckets, Rates, network_of
from service.app.application import create_app
from service.errors.faults import RateExceeded
from service.settings import Settings
from tests.service.access.test_keys import Clock
from tests.service.server import Server, assert_problem
from tests.service.wire import eventually

if TYPE_CHECKING:
    from service.shared.database import SharedDatabase

_NAMES = Statement(select(column("name")).select_from(table("rates")).order_by(column("name")))

SLOW = 0.01
"""A rate at which no test gets another token."""


def test_a_bucket_lets_a_burst_through_and_then_its_rate() -> None:
    clock = Clock(100.0)
    buckets = Buckets(2.0, 5, clock)
    assert [buckets.take("ann") for _ in range(5)] == [0.0] * 5
    assert buckets.take("ann") == pytest.approx(0.5)
    assert buckets.take("ann") == pytest.approx(0.5), "what was refused is not counted"
    assert buckets.take("bob") == 0.0
    clock.now += 0.5
    assert buckets.take("ann") == 0.0 and buckets.take("ann") > 0
    taken = 0
    for _ in range(1000):
        clock.now += 0.01
        taken += buckets.take("ann") == 0.0
    assert 19 <= taken <= 21, "two a second for ten seconds"
    clock.now += 3600
    assert [buckets.take("ann") for _ in range(6)] == [0.0] * 5 + [pytest.approx(0.5)], "no more than a burst is saved"


def test_no_rate_is_no_limit() -> None:
    buckets = Buckets(0.0, 1, Clock(0.0))
    assert all(buckets.take("ann") == 0.0 for _ in range(1000)) and len(buckets) == 0


def test_memory_is_bounded() -> None:
    buckets = Buckets(1.0, 1, Clock(0.0))
    for number in range(MOST_CALLERS + 100):
        buckets.take(f"key-{number}")
    assert len(buckets) == MOST_CALLERS
    assert buckets.take(f"key-{MOST_CALLERS + 99}") > 0, "the latest are remembered"


def test_wrong_keys_of_an_address_are_throttled() -> None:
    clock = Clock(0.0)
    rates = Rates(0.0, 1, clock=clock)
    for _ in range(FAILURE_BURST):
        rates.admit_failure("10.0.0.1")
    with pytest.raises(RateExceeded):
        rates.admit_failure("10.0.0.1")
    rates.admit_failure("10.0.0.2")
    clock.now += 1 / FAILURES_PER_SECOND
    rates.admit_failure("10.0.0.1")


def test_what_counts_as_one_caller() -> None:
    assert network_of("10.1.2.3") == "10.1.2.3" == network_of("::ffff:10.1.2.3")
    assert network_of("2001:db8:1:2::3") == network_of("2001:db8:1:2:ffff::1") != network_of("2001:db8:1:3::3")
    assert network_of(None) == network_of("") and network_of("/run/socket") == "/run/socket"


@pytest.mark.thorough
@pytest.mark.postgres
def test_what_one_service_lets_through_the_other_holds_back(database: SharedDatabase) -> None:
    one, other = (Buckets(SLOW, 10, kind="request") for _ in range(2))
    assert [one.take("ann") for _ in range(10)] == [0.0] * 10 and one.take("ann") > 0
    one.exchange(database)
    assert one.take("ann") == pytest.approx(1 / SLOW, rel=0.2)
    assert other.take("ann") == 0.0, "it has not heard of it yet"
    other.exchange(database)
    assert other.take("ann") == pytest.approx(2 / SLOW, rel=0.2), "what was too much is held back"
    assert other.take("bob") == 0.0
    for _ in range(3):  # what is taken meanwhile counts, too, and nothing counts twice
        other.take("bob")
        other.exchange(database)
    one.take("bob")
    one.exchange(database)
    assert [one.take("bob") for _ in range(6)] == [0.0] * 5 + [pytest.approx(1 / SLOW, rel=0.2)]


@pytest.mark.postgres
def test_services_exchange_both_limits_by_themselves(database: SharedDatabase) -> None:
    burst, asked = 1000, 0
    with Rates(SLOW, burst, database) as one, Rates(SLOW, burst, database) as other:
        for _ in range(burst):
            one.admit("ann")

        def refused() -> bool:
            nonlocal asked
            asked += 1
            return other.wait("ann") > 0

        assert eventually(refused) and asked <= burst, "before it had let so many through itself"
        one.admit_failure("10.0.0.1")
        found = [("failure 10.0.0.1",), ("request ann",)]
        assert eventually(lambda: database.execute("list the buckets", _NAMES) == found)


def test_without_the_database_each_service_keeps_to_the_limit_alone() -> None:
    from service.shared.database import SharedDatabase

    away = SharedDatabase("postgresql://placerec@127.0.0.1:9/postgres")
    alone = Buckets(SLOW, 3, kind="request")
    assert [alone.take("ann") for _ in range(4)] == [0.0] * 3 + [pytest.approx(1 / SLOW, rel=0.2)]
    with pytest.raises(StorageFailure):
        alone.exchange(away)
    assert alone._taken == {"ann": 3}, "it is added later"


@pytest.mark.anyio
async def test_a_key_over_its_rate_learns_when_to_come_again(tmp_path: Path) -> None:
    store = Keys.of(tmp_path)
    (_, first), (_, second) = store.create("ann", "query"), store.create("bob", "query")
    app = create_app(Settings(host="127.0.0.1", data_dir=tmp_path, rate_per_key=0.25, rate_burst=3))
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    with app.state.gate.keyring:
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:

            async def ask(token: str, path: str = "/nowhere") -> httpx.Response:
                return await client.get(path, headers={"Authorization": f"Bearer {token}"})

            assert [(await ask(first)).status_code for _ in range(3)] == [404] * 3
            refused = await ask(first)
            assert_problem(refused, 429, "rate-exceeded")
            assert refused.headers["retry-after"] == "4"
            assert (await ask(second)).status_code == 404, "another key has its own"
            assert (await ask(first, "/livez")).status_code == 200, "what is open is not counted"
            wrong = first[:-1] + ("A" if first[-1] != "A" else "B")
            for _ in range(FAILURE_BURST):
                assert_problem(await ask(wrong), 401, "key-refused")
            assert_problem(await ask(wrong), 429, "rate-exceeded")
            assert (await ask(second)).status_code == 404, "a right key is taken from the same address"


@pytest.mark.thorough
def test_wrong_keys_are_counted_whatever_address_they_claim(tmp_path: Path) -> None:
    """Each with another address in the header that a proxy would set, from this machine, where no proxy is named."""
    Keys.of(tmp_path / "data").create("admin", "admin")
    server = Server(tmp_path).wait("/livez")
    wrong = f"Bearer placerec_{'0' * 12}_{'x' * 43}"
    statuses = [
        server.client.get(
            "/v1/maps", headers={"Authorization": wrong, "X-Forwarded-For": f"10.0.0.{number}"}
        ).status_code
        for number in range(40)
    ]
    assert server.stop() == 0
    assert statuses[0] == 401 and 429 in statuses
