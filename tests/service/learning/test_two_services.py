"""Learning over two services on one store: each notes the frames that come to it, and a stranger at either counts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.shared.database import SharedDatabase
from tests.servers.postgres import Postgres
from tests.service.learning.test_lessons import (
    CORRIDOR,
    DARK,
    SAME,
    by_night,
    frames_of,
    lessons,
    proposals,
    taught,
)
from tests.service.map_jobs import wait_until
from tests.service.server import Server, typed
from tests.service.shared.services import two_services

pytestmark = [
    pytest.mark.postgres,
    pytest.mark.thorough,
    pytest.mark.skipif(not CORRIDOR.is_dir(), reason="needs the data set eval/corridor"),
]

PATH = "/v1/maps/hall/sessions"


@pytest.fixture
def services(tmp_path: Path, postgres: Postgres, database: SharedDatabase) -> Iterator[tuple[Server, Server]]:
    with two_services(tmp_path, postgres.address, {"encoder": "m-region-vlad"}) as both:
        taught(both[0], "hall", "propose")
        yield both


def send(server: Server, session: str, number: int, data: bytes, key: str | None = None) -> dict[str, Any]:
    odometry = {"odometry_x": number, "odometry_y": 0, "odometry_heading": 0, "frame": number}
    headers = typed(data) | ({} if key is None else {"Authorization": f"Bearer {key}"})
    answer = server.client.post(
        f"{PATH}/{session}/frames", params={name: str(value) for name, value in odometry.items()},
        content=data, headers=headers,
    )  # fmt: skip
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_a_run_whose_frames_come_to_two_services_teaches_the_right_places(services: tuple[Server, Server]) -> None:
    session = services[0].client.post(PATH, json={}).json()["id"]
    answers = [
        send(services[number % 2], session, number, by_night(number, plain))
        for number, plain in enumerate(frames_of("query"))
    ]
    doubted = [number for number in DARK if answers[number]["single"]["verdict"] != "recognized"]
    assert len(doubted) >= 8, "the dark hides too little for a test"
    assert services[1].client.delete(f"{PATH}/{session}").status_code == 204
    wait_until(lambda: len(lessons(services[0], "hall")) == 2)  # one at each service
    found = lessons(services[0], "hall")
    assert sorted(lesson["frames"] for lesson in found) == [30, 30]
    assert all(lesson["contradiction"] is None for lesson in found)
    proposed = proposals(services[0], "hall")
    assert len(proposed) >= len(doubted) / 3
    for frame in proposed:
        place, number = frame["answer"]["proposal"]["place"], frame["answer"]["frame"]
        assert abs(int(place[1:]) - number) <= SAME, "it is proposed at another place"
    assert {frame["answer"]["frame"] % 2 for frame in proposed} == {0, 1}, "both services have taught"


def test_a_stranger_at_the_other_service_keeps_a_run_from_teaching(services: tuple[Server, Server]) -> None:
    """A session that was begun while there were no keys is anybody's; any other refuses a stranger's frames."""
    one, other = services
    frames = frames_of("query")[:12]
    visited = one.client.post(PATH, json={}).json()["id"]
    for number, data in enumerate(frames):
        send(one, visited, number, data)
    boss = one.client.post("/v1/keys", json={"name": "boss", "role": "admin"}).json()["key"]
    for server in services:
        server.client.headers["Authorization"] = f"Bearer {boss}"
    made = {
        name: one.client.post("/v1/keys", json={"name": name, "role": "enrol", "learn": True}).json()["key"]
        for name in ("robot", "stranger")
    }
    known = {"Authorization": f"Bearer {made['stranger']}"}
    # Keys travel by the database; until then the other service needs none.
    wait_until(lambda: other.client.get("/v1/key", headers=known).json().get("name") == "stranger")
    send(other, visited, len(frames), frames[-1], made["stranger"])
    own = one.client.post(PATH, json={}, headers={"Authorization": f"Bearer {made['robot']}"}).json()["id"]
    for number, data in enumerate(frames):
        send(one, own, number, data, made["robot"])
    for session in (visited, own):
        assert other.client.delete(f"{PATH}/{session}").status_code == 204
        assert one.client.delete(f"{PATH}/{session}").status_code == 404
    wait_until(lambda: bool(lessons(one, "hall")))
    assert [lesson["session"] for lesson in lessons(one, "hall")] == [own]
