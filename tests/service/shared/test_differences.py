"""Services with different settings, encoders and clocks: each says so and goes on, and nothing is lost."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from service.peers.differences import COMMON, ReplicaDifferences
from service.peers.replica import ServiceReplica
from service.settings import Settings
from service.shared.database import SharedDatabase
from tests.servers.postgres import Postgres
from tests.service.encoders import COARSE, install_coarse_encoder, install_two_stage_encoder
from tests.service.server import Server
from tests.service.sessions.test_sessions import begin
from tests.service.shared.services import MAP, fill

FAKETIME = sorted(Path("/usr/lib").glob("*/faketime/libfaketime.so.1"))
SLOW = ("env", f"LD_PRELOAD={FAKETIME[0]}", "FAKETIME=-5m", "FAKETIME_DONT_FAKE_MONOTONIC=1") if FAKETIME else ()


def test_all_that_should_be_alike_are_settings() -> None:
    assert all(hasattr(Settings(), name) for name in COMMON)


@pytest.mark.postgres
@pytest.mark.thorough
def test_differences_are_reported_until_they_end(database: SharedDatabase, tmp_path: Path) -> None:
    replicas, services = [], []
    for name, rate in (("one", 5.0), ("other", 7.0)):
        models = tmp_path / f"models-{name}"
        if name == "other":
            install_two_stage_encoder(models)
        replica = ServiceReplica(database, tmp_path / name)
        given = Settings(data_dir=tmp_path / name, rate_per_key=rate, models_dir=models)
        replicas.append(replica)
        services.append(ReplicaDifferences(given, database, replica.id))

    def until(service: ReplicaDifferences, text: str, telling: list[ServiceReplica]) -> None:
        ends = time.monotonic() + 60
        while text not in service.state:
            assert time.monotonic() < ends, service.state
            for replica in telling:  # who has not for ten seconds is gone
                replica.beat()
            for each in services:
                each.compare()

    for service in services:
        until(service, "rate_per_key is not that of r-", replicas)
        until(service, "encoders is not that of r-", replicas)
    until(services[0], "ok", replicas[:1])


@pytest.mark.postgres
@pytest.mark.thorough
@pytest.mark.skipif(not FAKETIME, reason="libfaketime is not installed")
def test_a_clock_that_is_five_minutes_slow(postgres: Postgres, tmp_path: Path) -> None:
    postgres.empty()
    servers = []
    for name, wrapper in (("right", ()), ("slow", SLOW)):
        install_coarse_encoder(tmp_path / name / "models")
        servers.append(Server(tmp_path / name, {"encoder": COARSE, "database": postgres.address}, wrapper=wrapper))
    right, slow = (server.wait() for server in servers)
    fill(right)
    until = time.monotonic() + 60
    while "PostgreSQL" not in (said := slow.client.get("/readyz").json()["checks"]["others"]):
        assert time.monotonic() < until, said
        time.sleep(0.2)
    assert said == "The clock of this machine is 300 s behind PostgreSQL's."
    assert slow.lines(level="warning", message=f"{said[:-1]}: keys expire by it")
    assert right.client.get("/readyz").json()["checks"]["others"] == "ok"

    for begins, reads in ((right, slow), (slow, right)):  # nothing expires by the clock of the wrong one
        session = begin(begins, MAP, expires_after=60)
        assert reads.client.get(f"/v1/maps/{MAP}/sessions/{session}").status_code == 200
    assert [server.stop() for server in servers] == [0, 0]
