"""Two services on one PostgreSQL: each answers by what the other wrote last, and a silent server hangs nobody."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.servers.postgres import Postgres
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem
from tests.service.shared.services import expect_away, two_services

pytestmark = pytest.mark.postgres

SOON = 20.0
"""Seconds within which a request is answered though the database is silent; it would take 75 without a deadline."""


@pytest.fixture
def services(postgres: Postgres, tmp_path: Path) -> Iterator[tuple[Server, Server]]:
    """Two services that are given nothing but the address of the database."""
    postgres.empty()
    with two_services(tmp_path, postgres.address, {}) as both:
        yield both


def best(server: Server, number: int) -> str | None:
    """The id of the place that a frame is answered with first; None without any."""
    matches = server.query("lab", jpeg(number))["matches"]
    return matches[0]["place"]["id"] if matches else None


def test_each_service_answers_by_what_the_other_wrote_last(services: tuple[Server, Server]) -> None:
    here, there = services
    here.create_map("lab")
    for number in range(6):
        writer, reader = (here, there) if number % 2 else (there, here)
        assert writer.enrol("lab", f"p{number}", jpeg(number)).status_code == 201
        assert best(reader, number) == f"p{number}"
        assert writer.client.delete(f"/v1/maps/lab/places/p{number}").status_code == 204
        assert best(reader, number) != f"p{number}"
        assert writer.enrol("lab", f"q{number}", jpeg(number)).status_code == 201
        assert best(reader, number) == f"q{number}"
    assert here.client.patch("/v1/maps/lab", json={"description": "seen"}, headers={"If-Match": "*"}).status_code == 200
    assert there.client.get("/v1/maps/lab").json()["description"] == "seen"
    assert there.client.post("/v1/maps/lab/verify").json()["ok"]
    assert here.client.delete("/v1/maps/lab").status_code == 204
    assert_problem(there.client.get("/v1/maps/lab"), 404, "unknown-map")


@pytest.mark.thorough
def test_a_database_that_falls_silent_hangs_nobody(services: tuple[Server, Server], postgres: Postgres) -> None:
    server, _ = services
    server.create_map("lab")
    assert server.enrol("lab", "p1", jpeg(1)).status_code == 201
    assert best(server, 1) == "p1"
    with postgres.server.silenced():
        # Each has its own deadline, by the client's timeout; how long it took is not compared with anything else.
        asked = server.client.post("/v1/maps/lab/query", content=jpeg(1), timeout=SOON)
        problem = assert_problem(asked, 503, "store-unavailable")
        assert "PostgreSQL" in problem["detail"] and int(asked.headers["Retry-After"]) >= 1
        written = server.enrol("lab", "p2", jpeg(2))
        expect_away(written)
        ready = server.client.get("/readyz", timeout=SOON)
        assert ready.status_code == 503 and "PostgreSQL" in ready.json()["checks"]["maps"]
        assert server.client.get("/livez", timeout=SOON).status_code == 200
    server.wait()
    assert best(server, 1) == "p1"
    assert server.enrol("lab", "p2", jpeg(2)).status_code in (200, 201)
    assert best(server, 2) == "p2"
