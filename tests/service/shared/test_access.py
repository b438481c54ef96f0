"""Keys, the audit trail and the limits of requests at two services."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest

from service.access.keys import Keys
from service.shared.database import SharedDatabase
from tests.servers.postgres import Postgres
from tests.service.server import Server, assert_problem
from tests.service.shared.services import MAP, fill, two_services
from tests.service.wire import eventually

pytestmark = pytest.mark.postgres


@pytest.mark.thorough
def test_keys_work_at_all_services(tmp_path: Path, postgres: Postgres, database: SharedDatabase) -> None:
    admin = Keys.of(tmp_path, database).create("ops", "admin")[1]
    with two_services(tmp_path, postgres.address, {}, admin) as (one, other):
        fill(one)
        assert_problem(httpx.get(f"{one.client.base_url}/v1/maps"), 401, "key-needed")
        made = one.client.post("/v1/keys", json={"name": "robot", "role": "query"}).json()

        def status(server: Server) -> int:
            headers = {"Authorization": f"Bearer {made['key']}"}
            return httpx.get(f"{server.client.base_url}/v1/maps/{MAP}", headers=headers).status_code

        assert status(one) == 200, "at once where it was made"
        assert eventually(lambda: status(other) == 200)
        assert other.client.delete(f"/v1/keys/{made['id']}").status_code == 200
        assert status(other) == 401, "at once where it was revoked"
        assert eventually(lambda: status(one) == 401)

        def trail(server: Server) -> list[tuple[str | None, str]]:
            page = server.client.get("/v1/audit", params={"key": "ops"}).json()
            assert page["source"] == "database"
            return [
                (line["operation"], line["replica"]) for line in page["items"] if line["operation"].endswith("_key")
            ]

        assert eventually(lambda: len(trail(one)) == 2)
        assert trail(one) == trail(other)
        (revoked, at_other), (created, at_one) = trail(one)
        assert (revoked, created) == ("delete_key", "create_key") and at_one != at_other


@pytest.mark.thorough
def test_limits_hold_over_services(tmp_path: Path, postgres: Postgres, database: SharedDatabase) -> None:
    limits = {"rate_per_key": 0.01, "rate_burst": 20}
    with two_services(tmp_path, postgres.address, limits) as both:
        answers = [both[number % 2].client.get("/v1/maps") for number in range(60)]
    refused = [answer for answer in answers if answer.status_code != 200]
    assert_problem(refused[-1], 429, "rate-exceeded")
    assert 20 <= len(answers) - len(refused) <= 40, "at most the bursts of both"
