"""Loop closure over HTTP: locate a frame and enrol it if it is unknown, in one repeatable step."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np
import pytest

from tests.service.scenes import blank, encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem, text, typed

BACKGROUND = range(40, 48)


def close(server: Server, map_id: str, place_id: str, data: bytes, **parameters: object) -> httpx.Response:
    return server.client.post(
        f"/v1/maps/{map_id}/query:enrol", params=text({"id": place_id, **parameters}), content=data, headers=typed(data)
    )


def count(server: Server, map_id: str) -> int:
    places: int = server.client.get(f"/v1/maps/{map_id}").json()["places"]
    return places


def fill(server: Server, map_id: str) -> None:
    for number in BACKGROUND:
        server.enrol(map_id, f"b{number}", jpeg(number), x=100 * number, y=0)


def test_an_unknown_frame_becomes_a_place(server: Server, map_id: str) -> None:
    response = close(
        server, map_id, "p1", jpeg(1), x=3, y=4, heading=90, sequence="run", timestamp="2026-11-20T10:00:00Z",
        metadata={"floor": 2},
    )  # fmt: skip
    assert response.status_code == 201, response.text
    answer = response.json()
    assert (answer["verdict"], answer["reason"], answer["place"], answer["enrolment"]) == (
        "unknown", "empty-map", None, "created",
    )  # fmt: skip
    stored = server.client.get(f"/v1/maps/{map_id}/places/p1").json()
    assert stored == answer["enrolled"]
    assert stored["pose"] == {"x": 3, "y": 4, "heading": 90} and stored["metadata"] == {"floor": 2}
    assert (stored["sequence"], stored["timestamp"]) == ("run", "2026-11-20T10:00:00Z")


@pytest.mark.thorough
def test_a_known_frame_does_not_become_a_place(server: Server, map_id: str) -> None:
    fill(server, map_id)
    server.enrol(map_id, "p1", jpeg(1), x=0, y=0)
    before = count(server, map_id)
    response = close(server, map_id, "p2", encoded(seen_again(scene(1))))
    answer = response.json()
    assert response.status_code == 200 and answer["verdict"] == "recognized" and answer["place"]["id"] == "p1"
    assert (answer["enrolment"], answer["enrolled"]) == (None, None)
    assert count(server, map_id) == before
    assert server.client.get(f"/v1/maps/{map_id}/places/p2").status_code == 404


def test_the_very_picture_of_a_place_does_not_become_another(server: Server, map_id: str) -> None:
    """No parallax tells the two frames apart, so that no fundamental matrix alone could be found."""
    server.enrol(map_id, "p37", jpeg(37))
    response = close(server, map_id, "again", jpeg(37))
    answer = response.json()
    assert response.status_code == 200 and answer["verdict"] == "recognized" and answer["place"]["id"] == "p37", answer
    assert answer["enrolment"] is None and count(server, map_id) == 1


def test_a_mistyped_traverse_enrols_nothing(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p1", jpeg(1), sequence="monday")
    known = encoded(seen_again(scene(1)))
    assert_problem(close(server, map_id, "p2", known, sequences="mondy", sequence="tuesday"), 404, "unknown-sequence")
    assert_problem(close(server, map_id, "p2", known, sequences="monday,mondy"), 404, "unknown-sequence")
    assert count(server, map_id) == 1
    first = close(server, map_id, "p2", known, sequences="tuesday", sequence="tuesday")
    assert first.status_code == 201, "a run among its own frames begins with one"
    assert close(server, map_id, "p3", known, sequences="monday,tuesday", sequence="tuesday").status_code == 200


@pytest.mark.thorough
def test_a_request_can_be_repeated(server: Server, map_id: str) -> None:
    fill(server, map_id)
    first = close(server, map_id, "p1", jpeg(1), x=0, y=0)
    again = close(server, map_id, "p1", jpeg(1), x=0, y=0)
    assert (first.status_code, again.status_code) == (201, 200)
    assert (again.json()["verdict"], again.json()["enrolment"]) == ("unknown", "unchanged")
    assert again.json()["enrolled"] == first.json()["enrolled"]
    assert again.json()["score"] == first.json()["score"], "it does not find itself"
    assert_problem(close(server, map_id, "p1", jpeg(2)), 409, "place-taken")
    assert count(server, map_id) == len(BACKGROUND) + 1


@pytest.mark.thorough
def test_of_eight_robots_at_one_new_place_one_enrols_it(server: Server, map_id: str) -> None:
    fill(server, map_id)
    looks = [encoded(seen_again(scene(1), seed)) for seed in range(8)]
    with ThreadPoolExecutor(8) as pool:
        responses = list(pool.map(lambda i: close(server, map_id, f"robot-{i}", looks[i], x=0, y=0), range(8)))
    answers = [response.json() for response in responses]
    created = [answer["enrolled"]["id"] for answer in answers if answer["enrolment"] == "created"]
    assert len(created) == 1, answers
    assert sorted(response.status_code for response in responses) == [200] * 7 + [201]
    others = [answer for answer in answers if answer["enrolment"] is None]
    assert [answer["verdict"] for answer in others] == ["recognized"] * 7
    assert {answer["place"]["id"] for answer in others} == set(created)
    assert count(server, map_id) == len(BACKGROUND) + 1


@pytest.mark.thorough
def test_a_robot_does_not_find_its_own_last_frames(server: Server, map_id: str) -> None:
    fill(server, map_id)
    looks = [encoded(seen_again(scene(1), seed)) for seed in range(3)]
    for second, look in enumerate(looks[:2]):
        parameters = {"sequence": "run", "timestamp": f"2026-11-20T10:00:0{second}Z", "exclude_seconds": 30}
        answer = close(server, map_id, f"r{second}", look, **parameters).json()
        assert (answer["verdict"], answer["enrolment"]) == ("unknown", "created"), "it stands still"
    later = {"sequence": "run", "timestamp": "2026-11-20T10:09:00Z", "exclude_seconds": 30}
    answer = close(server, map_id, "r2", looks[2], **later).json()
    assert answer["matches"][0]["place"]["id"] in {"r0", "r1"} and answer["enrolment"] is None, "the loop is closed"
    behind = close(server, map_id, "r3", looks[2], sequence="run", exclude_frames=2).json()
    assert (behind["verdict"], behind["enrolment"]) == ("unknown", "created")


def test_a_blank_frame_is_no_place(server: Server, map_id: str) -> None:
    response = close(server, map_id, "p1", encoded(blank()))
    answer = response.json()
    assert response.status_code == 200
    assert (answer["verdict"], answer["reason"], answer["enrolment"], answer["enrolled"]) == (
        "unknown", "no-regions", None, None,
    )  # fmt: skip
    assert count(server, map_id) == 0


@pytest.mark.thorough
@pytest.mark.parametrize(("level", "noise"), [(20, 10), (128, 30)])
def test_what_a_covered_camera_shows_is_no_place(server: Server, map_id: str, level: int, noise: int) -> None:
    fill(server, map_id)
    random = np.random.default_rng(level)
    looks = [np.clip(random.normal(level, noise, (240, 320, 3)), 0, 255).astype(np.uint8) for _ in range(2)]
    for number, look in enumerate(looks):
        response = close(server, map_id, f"p{number}", encoded(look), x=0, y=0)
        answer = response.json()
        assert response.status_code == 200, answer
        assert (answer["verdict"], answer["enrolment"], answer["enrolled"]) == ("unknown", None, None)
    assert count(server, map_id) == len(BACKGROUND)


def test_invalid_loop_closures(server: Server, map_id: str) -> None:
    data = jpeg(1)
    path = f"/v1/maps/{map_id}/query:enrol"
    assert_problem(server.client.post(path, content=data, headers=typed(data)), 422, "invalid-request")
    assert_problem(close(server, map_id, "a/b", data), 422, "invalid-identifier")
    assert_problem(close(server, map_id, "p", data, x=1), 422, "invalid-request")
    assert_problem(close(server, map_id, "p", data, metadata="[]"), 422, "invalid-request")
    assert_problem(close(server, map_id, "p", data, camera="front"), 404, "unknown-camera")
    assert_problem(close(server, map_id, "p", data, encoder="other"), 409, "wrong-encoder")
    assert_problem(close(server, map_id, "p", data, exclude_frames=3), 422, "invalid-request")
    assert_problem(close(server, "no-such-map", "p", data), 404, "unknown-map")
    assert_problem(close(server, map_id, "p", b"plainly no picture"), 422, "not-an-image")
    assert count(server, map_id) == 0


@pytest.mark.thorough
def test_a_place_that_the_map_has_twice_is_not_enrolled_a_third_time(server: Server, map_id: str) -> None:
    """Two sequences without poses: the counterparts are rivals, which explains that neither can be recognized."""
    for sequence in ("monday", "tuesday"):
        for number in (1, *BACKGROUND):
            server.enrol(map_id, f"{sequence}-{number}", jpeg(number), sequence=sequence)
    before = count(server, map_id)
    answer = close(server, map_id, "again", encoded(seen_again(scene(1)))).json()
    assert (answer["verdict"], answer["place"], answer["enrolment"]) == ("ambiguous", None, None)
    (group,) = answer["rivals"]
    counterpart = "tuesday-1" if answer["matches"][0]["place"]["id"] == "monday-1" else "monday-1"
    assert group["places"] == [counterpart] and group["same_place"] is True
    assert count(server, map_id) == before
