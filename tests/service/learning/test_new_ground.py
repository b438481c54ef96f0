"""New ground over HTTP: a map with a gap, a run through it, and an operator who accepts what the run proposes.

The map is the first traverse of ``eval/corridor`` without its middle; robots go along the second one, a frame a metre.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from placerec_client import Client
from placerec_client.problems import TooManyPlaces, UnknownStretch
from tests.service.learning.test_lessons import CORRIDOR, frames_of, lessons
from tests.service.map_jobs import finished, places
from tests.service.server import Server, typed

GAP = range(22, 44)
SAME = 3.0

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.skipif(not CORRIDOR.is_dir(), reason="needs the data set eval/corridor"),
]


def gapped(server: Server, map_id: str, **learning: Any) -> None:
    """Make a map without the gap, which proposes new ground."""
    setting = {"mode": "propose", "new_ground": True, **learning}
    server.create_map(map_id, same_place_radius=SAME, learning=setting)
    for number, data in enumerate(frames_of("ref")):
        if number not in GAP:
            made = server.enrol(map_id, f"p{number}", data, x=number, y=0, heading=0, sequence="day")
            assert made.status_code == 201, made.text


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with the map ``hall``, which has a gap."""
    server = Server(tmp_path_factory.mktemp("new-ground"), {}).wait()
    gapped(server, "hall")
    yield server
    assert server.stop() == 0


def drive(server: Server, map_id: str, seed: int, frames: Sequence[bytes] | None = None) -> list[dict[str, Any]]:
    """A run along the corridor with 5 % of drift and a heading that drifts; what each frame alone was answered.

    The run is over when this returns, and its lesson is learnt.
    """
    random = np.random.default_rng(seed)
    path = f"/v1/maps/{map_id}/sessions"
    session = server.client.post(path, json={}).json()["id"]
    at, heading, scale, answers = 3 - 2j, 0.7, 1 + 0.05 * random.normal(), []
    for data in frames or frames_of("query"):
        odometry = {"odometry_x": at.real, "odometry_y": at.imag, "odometry_heading": math.degrees(heading)}
        answer = server.client.post(f"{path}/{session}/frames", params=odometry, content=data, headers=typed(data))
        assert answer.status_code == 200, answer.text
        answers.append(answer.json()["single"])
        at += complex(scale * (1 + 0.05 * random.normal()) * np.exp(1j * heading))
        heading += 0.01 * random.normal()
    assert server.client.delete(f"{path}/{session}").status_code == 204
    return answers


def waiting(server: Server, map_id: str) -> list[dict[str, Any]]:
    """The stretches that wait for review."""
    items: list[dict[str, Any]] = server.client.get(f"/v1/maps/{map_id}/review/stretches").json()["items"]
    return items


def right_and_wrong(server: Server, map_id: str, answers: Sequence[dict[str, Any]]) -> tuple[int, int]:
    """Of the frames in the gap, those recognized within the radius and a frame, and those farther away."""
    found = [answers[number] for number in GAP]
    where = {place: one["pose"]["x"] for place, one in places(server, map_id).items()}
    off = [
        abs(where[one["place"]["id"]] - number)
        for number, one in zip(GAP, found, strict=True)
        if one["verdict"] == "recognized"
    ]
    near = sum(metres <= SAME + 1 for metres in off)
    return near, len(off) - near


def test_a_run_through_a_gap_is_proposed_accepted_and_undone(running: Server) -> None:
    before = drive(running, "hall", 1)
    result = lessons(running, "hall")[0]
    assert result["new_ground"]["stretches"] == 1, result
    (stretch,) = waiting(running, "hall")
    assert stretch["run"] == result["session"] and stretch["missing"] == 0
    assert int(stretch["leaves"][1:]) < GAP[0] and int(stretch["returns"][1:]) > GAP[-1]
    assert stretch["leaves"] in stretch["why"] and stretch["returns"] in stretch["why"]
    # The frames of the gap are where they truly are, within what is said of them.
    numbers = {frame["id"]: frame["answer"]["stretch"]["frame"] for frame in reviewed(running, "hall")}
    truth = np.array([numbers[one["frame"]] for one in stretch["frames"]])
    x, y = (np.array([one["pose"][axis] for one in stretch["frames"]]) for axis in "xy")
    spread = np.array([one["spread"] for one in stretch["frames"]])
    off = np.hypot(x - truth, y)
    assert len(set(truth.tolist()) & set(GAP)) >= 0.8 * len(GAP) and off.max() < SAME and (off < 4 * spread).all()
    assert running.client.get("/v1/maps/hall").json()["places"] == 60 - len(GAP), "nobody has accepted it"
    # A second run over the same ground does not propose it twice.
    drive(running, "hall", 2)
    assert lessons(running, "hall")[0]["new_ground"]["refused"] == {"waits already": 1}
    accept = running.client.post(f"/v1/maps/hall/review/stretches/{stretch['id']}")
    assert accept.status_code == 202, accept.text
    job = finished(running, accept.json())
    count = len(stretch["frames"])
    assert job["state"] == "succeeded" and job["result"]["changes"] == {"created": count}, job
    assert running.client.get("/v1/maps/hall").json()["places"] == 60 - len(GAP) + count
    made = [one for one in places(running, "hall").values() if one["sequence"] == stretch["id"]]
    assert [one["id"] for one in made] == [one["place"] for one in stretch["frames"]]
    assert all(one["pose"]["x"] == known["pose"]["x"] for one, known in zip(made, stretch["frames"], strict=True))
    assert waiting(running, "hall") == []
    again = running.client.post(f"/v1/maps/hall/review/stretches/{stretch['id']}")
    assert (again.status_code, again.json()["type"].rpartition(":")[2]) == (404, "unknown-stretch")
    # A later run is recognized in the gap.
    after = drive(running, "hall", 3)
    right, wrong = right_and_wrong(running, "hall", after)
    was_right, was_wrong = right_and_wrong(running, "hall", before)
    assert right >= 0.8 * len(GAP) and wrong <= was_wrong and right > was_right + len(GAP) / 2
    assert lessons(running, "hall")[0]["new_ground"] == {"stretches": 0, "refused": {}}
    undone = running.client.delete("/v1/maps/hall/looks", params={"run": stretch["run"]}).json()
    assert undone == {"run": stretch["run"], "since": None, "until": None, "looks": 0, "places": count}
    assert running.client.get("/v1/maps/hall").json()["places"] == 60 - len(GAP)
    assert running.client.post("/v1/maps/hall/verify").json()["ok"]


def reviewed(server: Server, map_id: str) -> list[dict[str, Any]]:
    """The frames under review that are of a stretch."""
    items = server.client.get(f"/v1/maps/{map_id}/review", params={"limit": 100}).json()["items"]
    return [one for one in items if "stretch" in one["answer"]]


def test_rejected_ground_is_not_proposed_again_until_that_is_undone(running: Server) -> None:
    gapped(running, "lobby")
    drive(running, "lobby", 4)
    learnt = lessons(running, "lobby")[0]
    assert learnt["new_ground"] == {"stretches": 1, "refused": {}}
    with Client(str(running.client.base_url)) as client:  # the Python client asks for the same
        review = client.maps["lobby"].review
        (stretch,) = review.stretches()
        assert stretch.model_dump()["why"] == waiting(running, "lobby")[0]["why"]
        review.reject_stretch(stretch.id)
        assert waiting(running, "lobby") == [] == reviewed(running, "lobby")
        with pytest.raises(UnknownStretch):
            review.reject_stretch(stretch.id)
        drive(running, "lobby", 5)
        assert lessons(running, "lobby")[0]["new_ground"] == {"stretches": 0, "refused": {"rejected before": 1}}
        (rejected,) = running.client.get("/v1/maps/lobby").json()["learning"]["rejected_ground"]
        assert (rejected["stretch"], rejected["run"]) == (stretch.id, stretch.run)
        assert [pose["x"] for pose in rejected["poses"]] == [one.pose.x for one in stretch.frames]
        # The rejection is undone, but the map may not learn as many places.
        room = {"learning": {"rejected_ground": None, "most_places": len(stretch.frames) // 2}}
        assert running.client.patch("/v1/maps/lobby", json=room).json()["learning"]["rejected_ground"] == []
        drive(running, "lobby", 5)
        assert lessons(running, "lobby")[0]["new_ground"] == {"stretches": 0, "refused": {"most places": 1}}
        running.client.patch("/v1/maps/lobby", json={"learning": {"most_places": None}})
        drive(running, "lobby", 5)
        assert lessons(running, "lobby")[0]["new_ground"]["stretches"] == 1
        (again,) = review.stretches()
        running.client.patch("/v1/maps/lobby", json=room)
        with pytest.raises(TooManyPlaces):
            review.accept_stretch(again.id)
        running.client.patch("/v1/maps/lobby", json={"learning": {"most_places": len(again.frames)}})
        job = review.accept_stretch(again.id).wait()
        assert job.result and job.result["places"] == len(again.frames)
    running.client.delete("/v1/maps/lobby")


def test_a_run_through_another_building_joins_nothing(running: Server) -> None:
    street = sorted((CORRIDOR.parent / "lip6_outdoor" / "query").iterdir())[:60]
    drive(running, "hall", 5, [path.read_bytes() for path in street])
    result = lessons(running, "hall")[0]
    assert result["contradiction"] == "too few recognized" and not result["new_ground"]["stretches"]


def test_a_map_proposes_no_new_ground_by_default(running: Server) -> None:
    setting = running.create_map("plain")["learning"]
    assert (setting["mode"], setting["new_ground"], setting["rejected_ground"]) == ("off", False, [])
    edited = running.client.patch("/v1/maps/plain", json={"learning": {"new_ground": True}}).json()
    assert edited["learning"] == setting | {"new_ground": True}
    running.client.delete("/v1/maps/plain")


def test_a_service_that_is_killed_while_it_accepts_goes_on(tmp_path: Path) -> None:
    server = Server(tmp_path, {}).wait()
    gapped(server, "hall")
    drive(server, "hall", 1)
    lessons(server, "hall")
    (stretch,) = waiting(server, "hall")
    job = server.client.post(f"/v1/maps/hall/review/stretches/{stretch['id']}").json()
    server.kill()
    again = Server(tmp_path, {}).wait()
    ended = finished(again, job)
    assert ended["state"] == "succeeded" and ended["result"]["places"] == len(stretch["frames"]), ended
    assert again.client.get("/v1/maps/hall").json()["places"] == 60 - len(GAP) + len(stretch["frames"])
    assert waiting(again, "hall") == [] and again.client.post("/v1/maps/hall/verify").json()["ok"]
    assert again.stop() == 0
