"""The robots of all maps, over HTTP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx
import pytest

from service.access.keys import Keys
from tests.service.scenes import jpeg
from tests.service.server import Server


def send(client: httpx.Client, path: str, data: bytes) -> None:
    client.post(path, content=data, headers={"Content-Type": "image/jpeg"}).raise_for_status()


@pytest.mark.thorough
def test_robots_are_sessions_and_keys_and_say_since_when_they_are_lost(tmp_path: Path) -> None:
    store = Keys.of(tmp_path / "data")
    _, admin = store.create("ops", "admin")
    tokens = {name: store.create(name, "query")[1] for name in ("robot-7", "camera-2")}
    tokens["guest"] = store.create("guest", "query", ["yard"])[1]
    server = Server(tmp_path, key=admin).wait()
    url = str(server.client.base_url)
    try:
        for map_id in ("lab", "yard"):
            server.create_map(map_id)
        for number in range(4):
            server.enrol("lab", f"p{number}", jpeg(number), sequence="monday")

        def caller(name: str) -> httpx.Client:
            return httpx.Client(base_url=url, headers={"Authorization": f"Bearer {tokens[name]}"}, timeout=60)

        def robots(client: httpx.Client = server.client) -> dict[str, dict[str, Any]]:
            told = client.get("/v1/fleet").raise_for_status().json()["robots"]
            return {one["name"] or one["session"] or "": one for one in told}

        with caller("robot-7") as robot, caller("camera-2") as camera, caller("guest") as guest:
            session = robot.post("/v1/maps/lab/sessions", json={}).json()["id"]
            assert robots() == {}, "a session without a frame is nowhere"
            send(robot, f"/v1/maps/lab/sessions/{session}/frames", jpeg(1))
            send(camera, "/v1/maps/lab/query", jpeg(2))
            found = robots()
            assert found.keys() == {"robot-7", "camera-2"}
            seven = found["robot-7"]
            assert (seven["session"], seven["map"], seven["place"]) == (session, "lab", "p1")
            assert (seven["verdict"], seven["verdicts"], seven["lost_since"]) == ("recognized", ["recognized"], None)
            assert found["camera-2"]["session"] is None and found["camera-2"]["lost_since"] is None

            for _ in range(2):
                send(camera, "/v1/maps/lab/query?sequences=tuesday", jpeg(1))  # which no place is of
            lost = robots()["camera-2"]
            answers = camera.get("/v1/maps/lab/answers", params={"limit": 3}).json()["items"]
            assert [one["verdict"] for one in answers] == ["unknown", "unknown", "recognized"] == lost["verdicts"]
            assert (lost["lost_since"], lost["recognized_at"]) == (answers[1]["at"], answers[2]["at"])
            assert (lost["last_at"], lost["place"], lost["answers"]) == (answers[0]["at"], "p2", 3)

            told = server.client.get("/v1/fleet").json()
            (lab,) = told["maps"]
            assert (lab["map"], lab["sessions"]) == ("lab", 1)
            assert sum(hour["recognized"] for hour in lab["hours"]) == 2
            seen = robots(robot)
            assert session in seen and all(one["name"] is None for one in seen.values()), "names are for enrolment"
            assert guest.get("/v1/fleet").json()["maps"] == [] and robots(guest) == {}

            assert robot.delete(f"/v1/maps/lab/sessions/{session}").status_code == 204
            assert robots()["robot-7"]["place"] == "p1", "what a session answered stays its robot's"
    finally:
        assert server.stop() == 0
