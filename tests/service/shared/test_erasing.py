"""What one service erases is gone at the others, with what they noted of the run."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from service.shared.database import SharedDatabase
from tests.servers.postgres import Postgres
from tests.service.map_jobs import asked, finished
from tests.service.places.test_looks import add_look
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem
from tests.service.sessions.test_sessions import again, begin, send
from tests.service.shared.services import MAP, PLACES, fill, two_services

pytestmark = [pytest.mark.postgres, pytest.mark.thorough, pytest.mark.timeout(300)]


def test_looks_and_runs_are_erased_at_all_services(
    tmp_path: Path, postgres: Postgres, database: SharedDatabase
) -> None:
    with two_services(tmp_path, postgres.address, {}) as (one, other):
        fill(one)
        assert one.client.patch(f"/v1/maps/{MAP}", json={"learning": {"mode": "propose"}}).is_success
        look = add_look(one, MAP, "p1", jpeg(71)).json()["name"]
        path = f"/v1/maps/{MAP}/places/p1/looks/{look}"
        assert other.query(MAP, jpeg(71))["matches"][0]["place"]["look"] == look
        assert other.client.get(f"{path}/thumbnail").status_code == 200
        session = driven(other)
        job = finished(one, asked(one, MAP, "erase", ids=[f"p1/{look}"], session=session), 200)
        assert job["state"] == "succeeded" and job["result"]["looks"] == 1, job
        assert "look" not in other.query(MAP, jpeg(71))["matches"][0]["place"]
        assert_problem(other.client.get(f"{path}/thumbnail"), 404, "unknown-look")
        assert_problem(other.client.get(f"/v1/maps/{MAP}/sessions/{session}"), 404, "unknown-session")


def test_no_run_of_erased_frames_teaches_at_any_service(
    tmp_path: Path, postgres: Postgres, database: SharedDatabase
) -> None:
    """Either service may take the job: it drops its own notes, and the other one's lesson finds the job."""
    with two_services(tmp_path, postgres.address, {}) as services:
        one = services[0]
        fill(one)
        assert one.client.patch(f"/v1/maps/{MAP}", json={"learning": {"mode": "propose"}}).is_success
        before = datetime.now(UTC).isoformat()
        runs = {driven(service): service for service in services}
        job = finished(one, asked(one, MAP, "erase", filter={"after": before}), 200)
        assert job["state"] == "succeeded" and job["result"]["places"] == 0, job
        for run, service in runs.items():
            assert service.client.delete(f"/v1/maps/{MAP}/sessions/{run}").status_code == 204
        lessons = [job for job in one.client.get("/v1/jobs").json()["items"] if job["kind"] == "learn"]
        assert [finished(one, lesson)["result"]["contradiction"] for lesson in lessons] == ["erased"]


def driven(service: Server) -> str:
    """A session of a map that learns, with as many frames as a lesson needs."""
    session = begin(service, MAP)
    for number in range(PLACES):
        pose = {"odometry_x": 2.0 * number, "odometry_y": 0.0, "odometry_heading": 0.0}
        send(service, MAP, session, again(number), frame=number, **pose)
    return session
