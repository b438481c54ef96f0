"""Two services with the same maps, sessions and jobs, of which one is killed in the middle of a job."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from tests.servers.postgres import Postgres
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.map_jobs import asked, places
from tests.service.scenes import jpeg
from tests.service.server import Server
from tests.service.sessions.test_sessions import again, begin, send

pytestmark = [pytest.mark.postgres, pytest.mark.thorough, pytest.mark.timeout(900)]

PLACES = 40


def test_a_killed_service(postgres: Postgres, tmp_path: Path) -> None:
    settings = {"encoder": COARSE, "database": postgres.address}
    services = []
    for name in ("one", "other"):
        install_coarse_encoder(tmp_path / name / "models")
        services.append(Server(tmp_path / name, settings=settings))
    one, other = (service.wait() for service in services)
    one.create_map("lab", encoder=COARSE, keep="image")
    for number in range(PLACES):
        service = services[number % 2]
        enrolled = service.enrol("lab", f"p{number}", jpeg(number), x=2 * number, y=0, sequence="monday")
        assert enrolled.status_code == 201, enrolled.text
    assert other.query("lab", again(5))["matches"][0]["place"]["id"] == "p5"
    session = begin(one, "lab")
    for number in range(4):
        before = send(one, "lab", session, again(number), frame=number)
    asked(one, "lab", "re-encode", to="lab-2", encoder=COARSE)
    (job,) = other.client.get("/v1/jobs").json()["items"]
    while (seen := other.client.get(f"/v1/jobs/{job['id']}").json())["state"] == "queued":
        time.sleep(0.01)
    doing = next(service for service in services if service.lines(message="job running", job=job["id"]))
    left = one if doing is other else other
    doing.kill()
    began = time.monotonic()
    assert seen["state"] == "running", "there was not enough to do"

    assert send(left, "lab", session, again(3), frame=3)["candidates"] == before["candidates"]
    assert send(left, "lab", session, again(4), frame=4)["frames"] == 5
    while (ended := left.client.get(f"/v1/jobs/{job['id']}", params={"wait": 60}).json())["ended_at"] is None:
        assert time.monotonic() < began + 300
    print(f"the job has ended {time.monotonic() - began:.1f} s after the kill of the service that did it")
    assert (ended["state"], ended["attempt"], ended["result"]["places"]) == ("succeeded", 2, PLACES), ended
    assert list(places(left, "lab-2")) == list(places(left, "lab"))
    assert left.query("lab-2", again(7))["matches"][0]["place"]["id"] == "p7"
    assert left.stop() == 0
