"""Two services on one PostgreSQL behind a real nginx, of which one is killed."""

from __future__ import annotations

import shutil
from pathlib import Path

import httpx
import pytest

from tests.servers.postgres import Postgres
from tests.service.balancer import balanced
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import jpeg
from tests.service.server import Server, typed

pytestmark = [
    pytest.mark.postgres,
    pytest.mark.thorough,
    pytest.mark.timeout(600),
    pytest.mark.skipif(shutil.which("nginx") is None, reason="nginx is not installed"),
]


def test_robots_do_not_notice_that_a_replica_is_killed(postgres: Postgres, tmp_path: Path) -> None:
    replicas = []
    for number in range(2):
        folder = tmp_path / f"replica-{number}"
        install_coarse_encoder(folder / "models")
        replicas.append(Server(folder, {"encoder": COARSE, "database": postgres.address}))
    for replica in replicas:
        replica.wait()
    front = tmp_path / "nginx"
    front.mkdir()
    with (
        balanced([replica.port for replica in replicas], front) as url,
        httpx.Client(base_url=url, timeout=60) as robot,
    ):
        assert robot.post("/v1/maps", json={"id": "shared"}).status_code == 201
        for number in range(6):
            written = robot.put(f"/v1/maps/shared/places/p{number}", content=jpeg(number), headers=typed(jpeg(number)))
            assert written.status_code == 201, written.text

        for asked in range(30):
            number = asked % 6
            if asked == 10:
                replicas[0].kill()
            answer = robot.post("/v1/maps/shared/query", content=jpeg(number), headers=typed(jpeg(number)))
            assert answer.status_code == 200, answer.text
            assert answer.json()["matches"][0]["place"]["id"] == f"p{number}"
        asked_of = (front / "access.log").read_text()
        assert all(f"127.0.0.1:{replica.port}" in asked_of for replica in replicas), "one was never asked"
        assert robot.delete("/v1/maps/shared").status_code == 204
    assert replicas[1].stop() == 0
