"""Sessions over HTTP: a robot's run, frame by frame."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.sessions.schemas import NewSession
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.engines import ENCODER, enrolments, runtime_at
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem, text, typed

NUMBER = 8


def again(number: int) -> bytes:
    """Place ``number`` of the traverse, seen another day."""
    return encoded(seen_again(scene(number)))


def begin(server: Server, map_id: str, **options: object) -> str:
    response = server.client.post(f"/v1/maps/{map_id}/sessions", json=options)
    assert response.status_code == 201, response.text
    assert response.headers["location"] == f"/v1/maps/{map_id}/sessions/{response.json()['id']}"
    return str(response.json()["id"])


def post(
    server: Server, map_id: str, session: str, data: bytes, request_id: str | None = None, **parameters: Any
) -> httpx.Response:
    return server.client.post(
        f"/v1/maps/{map_id}/sessions/{session}/frames",
        params=text(parameters),
        content=data,
        headers=typed(data) | ({} if request_id is None else {"X-Request-Id": request_id}),
    )


def send(server: Server, map_id: str, session: str, data: bytes, **parameters: Any) -> dict[str, Any]:
    response = post(server, map_id, session, data, **parameters)
    assert response.status_code == 200, response.text
    answer: dict[str, Any] = response.json()
    return answer


@pytest.mark.thorough
@pytest.mark.parametrize("options", [{}, {"advance": 1.0}, {"lag": 2}])
def test_a_run_along_the_traverse(server: Server, traverse: str, options: dict[str, object]) -> None:
    session = begin(server, traverse, **options)
    for number in range(NUMBER):
        answer = send(server, traverse, session, again(number), frame=number)
        assert (answer["session"], answer["frame"], answer["frames"]) == (session, number, number + 1)
        shares = [candidate["probability"] for candidate in answer["candidates"]]
        assert sum(shares) + answer["unknown"] == pytest.approx(1, abs=5e-3) or len(shares) == 5
        assert shares == sorted(shares, reverse=True)
        assert answer["single"]["matches"][0]["place"]["id"] == f"p{number}"
        assert answer["milliseconds"]["belief"] < 1e3 * answer["milliseconds"]["total"]
    assert answer["verdict"] == "recognized" and not answer["lost"]
    # Places up to three frames off are the same place; the one told lies in the middle of what is believed.
    assert abs(answer["place"]["pose"]["x"] - 14) <= 5
    assert answer["probability"] == shares[0] > 0.5
    if "lag" in options:
        assert answer["earlier"]["frames_ago"] == 2 and answer["earlier"]["candidates"]
    else:
        assert answer["earlier"] is None


def test_a_session_can_be_read_listed_and_ended(server: Server, traverse: str) -> None:
    session = begin(server, traverse, expires_after=60, advance=0.5)
    send(server, traverse, session, again(2), frame=7)
    path = f"/v1/maps/{traverse}/sessions"
    read = server.client.get(f"{path}/{session}").json()
    assert (read["id"], read["map"], read["frames"], read["last_frame"]) == (session, traverse, 1, 7)
    assert (read["advance"], read["expires_after"], read["restored"]) == (0.5, 60, False)
    assert read["expires_at"] > read["created_at"]
    assert read["belief"]["candidates"][0]["place"]["id"] == "p2"
    assert {key: value for key, value in read.items() if key != "belief"} in server.client.get(path).json()["items"]
    other = begin(server, traverse)
    first = server.client.get(path, params={"limit": 1}).json()
    second = server.client.get(path, params={"limit": 1, "cursor": first["next_cursor"]}).json()
    assert first["items"][0]["id"] < second["items"][0]["id"]
    for ended in (session, other):
        assert server.client.delete(f"{path}/{ended}").status_code == 204
        assert_problem(server.client.get(f"{path}/{ended}"), 404, "unknown-session")
        assert_problem(server.client.delete(f"{path}/{ended}"), 404, "unknown-session")
    assert_problem(post(server, traverse, session, again(1)), 404, "unknown-session")


@pytest.mark.thorough
def test_a_frame_sent_again_counts_once(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    first = send(server, traverse, session, again(1), frame=4)
    second = send(server, traverse, session, again(1), frame=4)
    assert second["repeated"] and not first["repeated"]
    assert (second["frames"], second["candidates"]) == (1, first["candidates"])
    assert_problem(post(server, traverse, session, again(1), frame=3), 409, "frame-out-of-order")
    assert send(server, traverse, session, again(2), frame=5)["frames"] == 2

    unnumbered = begin(server, traverse)
    once = post(server, traverse, unnumbered, again(1), "robot-7").json()
    twice = post(server, traverse, unnumbered, again(1), "robot-7").json()
    assert (once["frames"], twice["frames"], twice["repeated"]) == (1, 1, True)
    assert send(server, traverse, unnumbered, again(1))["frames"] == 2, "under another id it is another frame"


def test_the_request_that_begins_a_session_can_be_sent_again(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p1", jpeg(1), sequence="walk")

    def begun(request_id: str | None, **options: object) -> str:
        headers = {} if request_id is None else {"X-Request-Id": request_id}
        response = server.client.post(f"/v1/maps/{map_id}/sessions", json=options, headers=headers)
        assert response.status_code == 201, response.text
        assert response.headers["location"].endswith(response.json()["id"])
        return str(response.json()["id"])

    first = begun("begin-7", lag=2)
    assert begun("begin-7", lag=2) == first
    others = [begun("begin-8", lag=2), begun("begin-7", lag=3), begun(None, lag=2), begun(None, lag=2)]
    assert len({first, *others}) == 5, "another id, other options, no id"
    send(server, map_id, first, again(1))
    assert begun("begin-7", lag=2) not in {first, *others}, "a session with a frame is a robot's"


@pytest.mark.thorough
def test_frames_go_in_one_at_a_time(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda number: send(server, traverse, session, again(number)), range(4)))
    assert sorted(answer["frames"] for answer in answers) == [1, 2, 3, 4]


def test_a_bad_frame_does_not_count(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    send(server, traverse, session, again(1), frame=1)
    for data, kind, status, slug in (
        (b"", "image/jpeg", 422, "empty-image"),
        (b"no picture", "image/jpeg", 422, "not-an-image"),
        (again(2)[:2000], "image/jpeg", 422, "truncated-image"),
        (again(2), "image/png", 415, "unsupported-media-type"),
    ):
        bad = server.client.post(
            f"/v1/maps/{traverse}/sessions/{session}/frames?frame=2", content=data, headers={"Content-Type": kind}
        )
        assert_problem(bad, status, slug)
    assert send(server, traverse, session, again(2), frame=2)["frames"] == 2


AT: dict[str, Any] = {"odometry_x": 1, "odometry_y": 2, "odometry_heading": 90}


@pytest.mark.parametrize(
    "parameters",
    [
        {"frame": -1},
        {"frame": "x"},
        {"timestamp": "yesterday"},
        {"forward": "nan"},
        {"turn": 90},
        {"left": 1},
        {"odometry_x": 1, "odometry_y": 1},
        {"odometry_y": 1},
        {"odometry_heading": 90},
        {"odometry_origin": "a"},
        {"odometry_covariance": "0,0,0,0,0,0,0,0,0"},
        {**AT, "odometry_x": "inf"},
        {**AT, "odometry_heading": 361},
        {**AT, "odometry_heading": -361},
        {**AT, "odometry_covariance": "1_0,0,0,0,1,0,0,0,1"},
        {**AT, "odometry_origin": "a" * 129},
        {**AT, "odometry_covariance": "1,0,0,0,1,0,0,0"},
        {**AT, "odometry_covariance": "1,0,0,0,1,0,0,0,nan"},
        {**AT, "odometry_covariance": "1,0,0,0,1,0,0,0,-1"},
        {**AT, "odometry_covariance": "1,2,0,0,1,0,0,0,1"},
        {**AT, "forward": 1},
        {"k": 0},
        {"speed": 3},
    ],
)
def test_bad_parameters_of_a_frame(server: Server, traverse: str, parameters: dict[str, Any]) -> None:
    session = begin(server, traverse)
    assert_problem(post(server, traverse, session, again(1), **parameters), 422, "invalid-request")


@pytest.mark.parametrize(
    "options",
    [
        {"speed_limit": 0},
        {"speed_limit": "fast"},
        {"advance": -1},
        {"lag": 21},
        {"expires_after": 0},
        {"sequences": []},
        {"particles": 10},
        [],
    ],
)
def test_bad_options_of_a_session(server: Server, traverse: str, options: object) -> None:
    assert_problem(server.client.post(f"/v1/maps/{traverse}/sessions", json=options), 422, "invalid-request")


@pytest.mark.parametrize("option", [{"filter": "path"}, {"filter": "bayes"}, {"path_frames": 10}])
def test_the_choice_of_a_filter_is_refused_in_words(server: Server, traverse: str, option: dict[str, object]) -> None:
    refused = server.client.post(f"/v1/maps/{traverse}/sessions", json=option)
    assert_problem(refused, 422, "invalid-request")
    assert f"there is no option {next(iter(option))} any more" in refused.text


def test_a_session_needs_existing_sequences_and_cameras(server: Server, traverse: str) -> None:
    path = f"/v1/maps/{traverse}/sessions"
    assert_problem(server.client.post(path, json={"sequences": ["tuesday"]}), 404, "unknown-sequence")
    assert_problem(server.client.post(path, json={"camera": "left"}), 404, "unknown-camera")
    assert_problem(server.client.post("/v1/maps/nowhere/sessions", json={}), 404, "unknown-map")
    broken = server.client.post(path, content=b"{", headers={"Content-Type": "application/json"})
    assert_problem(broken, 400, "malformed-body")
    assert_problem(server.client.post(path, content=b"{}"), 415, "unsupported-media-type")
    assert_problem(server.client.get(f"{path}/s-1"), 404, "unknown-session")
    session = begin(server, traverse)
    assert_problem(post(server, traverse, session, again(1), encoder=COARSE), 409, "wrong-encoder")


def test_a_speed_limit_needs_timestamps_that_grow(server: Server, traverse: str) -> None:
    session = begin(server, traverse, speed_limit=2.0)
    assert_problem(post(server, traverse, session, again(1)), 422, "invalid-request")
    first = send(server, traverse, session, again(1), timestamp="2026-11-20T10:00:00Z")
    second = send(server, traverse, session, again(2), timestamp="2026-11-20T10:00:01Z")
    assert (first["motion"], second["motion"]) == ("first", "speed-limit")
    late = post(server, traverse, session, again(2), timestamp="2026-11-20T10:00:00.5Z")
    assert_problem(late, 409, "frame-out-of-order")


def test_odometry(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    send(server, traverse, session, again(1))
    answer = send(server, traverse, session, again(2), forward=2.0, turn=0, deviation=0.1)
    assert answer["motion"] == "odometry"


@pytest.mark.thorough
def test_odometry_by_pose(server: Server, traverse: str) -> None:
    session, other = begin(server, traverse, speed_limit=3.0), begin(server, traverse, speed_limit=3.0)

    def told(number: int, x: float, **more: Any) -> dict[str, Any]:
        stamp = f"2026-11-20T10:00:{number:02d}Z"
        pose = {"odometry_x": x, "odometry_y": 7, "odometry_heading": 180, **more}
        return send(server, traverse, session, again(number), frame=number, timestamp=stamp, **pose)

    answers = [told(1, 50.0), told(2, 48.0), told(3, 46.0, odometry_covariance="0.1,0,0,0,0.1,0,0,0,0.01")]
    for number, motion in ((1, {}), (2, {"forward": 2.0}), (3, {"forward": 2.0})):
        stamp = f"2026-11-20T10:00:{number:02d}Z"
        expected = send(server, traverse, other, again(number), frame=number, timestamp=stamp, **motion)
        found = answers[number - 1]
        assert (found["motion"], found["candidates"]) == (expected["motion"], expected["candidates"])
    assert answers[-1]["motion"] == "odometry"
    assert told(4, 0.0)["motion"] == "speed-limit", "odometry that jumps has begun anew"
    assert told(5, -2.0)["motion"] == "odometry"
    assert told(6, -4.0, odometry_origin="again")["motion"] == "speed-limit"
    assert told(6, 77.0, odometry_origin="again")["repeated"], "the same frame, whatever it says"
    assert told(7, -6.0, odometry_origin="again")["motion"] == "odometry"


def test_a_form_gives_the_same_answer(server: Server, traverse: str) -> None:
    raw, form = begin(server, traverse), begin(server, traverse)
    expected = send(server, traverse, raw, again(3), frame=1)
    response = server.client.post(
        f"/v1/maps/{traverse}/sessions/{form}/frames",
        data={"frame": "1"},
        files={"image": ("f.jpg", again(3), "image/jpeg")},
    )
    assert response.json()["candidates"] == expected["candidates"]


@pytest.mark.thorough
def test_a_robot_that_leaves_the_map_or_is_carried_off(server: Server, map_id: str) -> None:
    for number in range(24):
        server.enrol(map_id, f"p{number}", jpeg(number), sequence="monday")
    session = begin(server, map_id)
    for number in range(5):
        answer = send(server, map_id, session, again(number))
    assert answer["verdict"] == "recognized" and answer["place"]["id"] in {"p3", "p4", "p5"}
    for number in range(100, 114):  # where nobody enrolled anything
        answer = send(server, map_id, session, jpeg(number))
    assert answer["verdict"] == "unknown" and answer["place"] is None
    assert answer["unknown"] > 0.5 and answer["lost"]
    for number in range(2, 8):  # carried back, and not to where it was lost
        answer = send(server, map_id, session, again(number))
    assert answer["verdict"] == "recognized" and answer["place"]["id"] in {"p6", "p7", "p8"}
    assert not answer["lost"]


@pytest.mark.thorough
def test_a_robot_that_stands_and_a_covered_camera(server: Server, traverse: str) -> None:
    session = begin(server, traverse)
    for number in range(4):
        answer = send(server, traverse, session, again(number))
        assert answer["view"] is None
    for _ in range(3):
        stands = send(server, traverse, session, again(3))
        assert (stands["view"], stands["verdict"]) == ("constant", "recognized")
        assert stands["probability"] == pytest.approx(answer["probability"], abs=1e-3)
    covered = [send(server, traverse, session, encoded(blank(320, 240))) for _ in range(4)]
    assert {one["view"] for one in covered} == {"covered"}
    assert (covered[-1]["verdict"], covered[-1]["place"]) == ("unknown", None)
    uncovered = send(server, traverse, session, again(5))
    assert (uncovered["view"], uncovered["verdict"]) == (None, "recognized")


@pytest.mark.thorough
def test_only_the_sequences_that_are_named(server: Server, map_id: str) -> None:
    for day in ("monday", "tuesday"):
        for number in range(4):
            server.enrol(map_id, f"{day}{number}", jpeg(number if day == "monday" else 40 + number), sequence=day)
    session = begin(server, map_id, sequences=["tuesday"])
    for number in range(3):
        answer = send(server, map_id, session, again(number))
    assert {candidate["place"]["sequence"] for candidate in answer["candidates"]} == {"tuesday"}
    assert {match["place"]["sequence"] for match in answer["single"]["matches"]} == {"tuesday"}


@pytest.mark.thorough
def test_places_come_and_go_during_a_run(server: Server, map_id: str) -> None:
    for number in range(8):
        server.enrol(map_id, f"p{number}", jpeg(number), x=10 * number, y=0, sequence="monday")
    session = begin(server, map_id)
    for number in range(4):
        answer = send(server, map_id, session, again(number))
    assert answer["place"]["id"] == "p3"
    assert server.client.delete(f"/v1/maps/{map_id}/places/p3").status_code == 204
    server.enrol(map_id, "q4", jpeg(44), x=40, y=5, sequence="monday")
    read = server.client.get(f"/v1/maps/{map_id}/sessions/{session}").json()
    assert "p3" not in {candidate["place"]["id"] for candidate in read["belief"]["candidates"]}
    for number in range(4, 8):
        answer = send(server, map_id, session, again(number))
        assert "p3" not in {candidate["place"]["id"] for candidate in answer["candidates"]}
    assert answer["place"]["id"] == "p7"


def test_an_empty_map_and_a_blank_frame(server: Server, map_id: str) -> None:
    session = begin(server, map_id)
    answer = send(server, map_id, session, jpeg(1))
    assert (answer["verdict"], answer["unknown"], answer["candidates"]) == ("unknown", 1.0, [])
    assert answer["single"]["reason"] == "empty-map" and answer["probability"] is None
    server.enrol(map_id, "p", jpeg(1))
    assert send(server, map_id, session, jpeg(1))["candidates"][0]["place"]["id"] == "p"


def test_a_session_ends_with_its_map(server: Server, map_id: str) -> None:
    session = begin(server, map_id)
    server.client.delete(f"/v1/maps/{map_id}")
    assert_problem(server.client.get(f"/v1/maps/{map_id}/sessions/{session}"), 404, "unknown-map")
    server.create_map(map_id)
    assert_problem(server.client.get(f"/v1/maps/{map_id}/sessions/{session}"), 410, "session-expired")


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Server]:
    """A service that keeps two sessions, for four seconds."""
    install_coarse_encoder(tmp_path / "models")
    settings = {"max_sessions": 2, "session_expiry": 4, "max_session_memory": 1 << 20, "encoder": COARSE}
    running = Server(tmp_path, settings=settings).wait()
    running.create_map("lab")
    yield running
    assert running.stop() == 0


def test_the_graphs_of_deleted_sessions_are_dropped(tmp_path: Path) -> None:
    with runtime_at(tmp_path) as runtime:
        map_ = runtime.engine.maps.create("lab", ENCODER, 8)
        map_.open()
        for number in range(4):
            map_.enrol(enrolments(10 * number, 3, "p", f"s{number}"))
        runtime.sessions.create(map_, NewSession())
        for number in range(4):
            runtime.sessions.delete(runtime.sessions.create(map_, NewSession(sequences=[f"s{number}"])))
        assert len(runtime.sessions._graphs) == 1 and runtime.sessions.count() == 1
        runtime.sessions.close()


@pytest.mark.thorough
def test_sessions_expire_and_are_bounded(small: Server) -> None:
    for number in range(3):
        small.enrol("lab", f"p{number}", jpeg(number))
    first, second = begin(small, "lab"), begin(small, "lab", expires_after=3600)
    refused = small.client.post("/v1/maps/lab/sessions", json={})
    assert_problem(refused, 429, "too-many-sessions")
    assert float(refused.headers["retry-after"]) > 0
    until = time.monotonic() + 4.5
    while time.monotonic() < until:
        send(small, "lab", first, jpeg(1))
        time.sleep(0.2)
    assert_problem(post(small, "lab", second, jpeg(1)), 410, "session-expired")
    assert send(small, "lab", first, jpeg(1))["frames"] > 1, "one that is used lives on"
    assert small.client.get("/v1/maps/lab/sessions").json()["items"][0]["id"] == first
    small.client.delete(f"/v1/maps/lab/sessions/{first}")
    blank_one = begin(small, "lab")
    answer = send(small, "lab", blank_one, encoded(blank()))
    assert (answer["frames"], answer["single"]["reason"]) == (1, "no-regions")


RESTARTED: dict[str, dict[str, object]] = {"speed unknown": {}, "advance fixed": {"advance": 1.0}}


@pytest.mark.thorough
@pytest.mark.parametrize("end", ["kill", pytest.param("stop", marks=pytest.mark.thorough)])
def test_a_session_goes_on_after_a_restart(tmp_path: Path, end: str) -> None:
    install_coarse_encoder(tmp_path / "models")
    settings = {"encoder": COARSE}
    first = Server(tmp_path, settings=settings).wait()
    first.create_map("lab")
    for number in range(NUMBER):
        first.enrol("lab", f"p{number}", jpeg(number), sequence="monday")
    sessions = {name: begin(first, "lab", **options) for name, options in RESTARTED.items()}
    before = {
        name: [send(first, "lab", session, again(number), frame=number) for number in range(4)][-1]
        for name, session in sessions.items()
    }
    damaged = begin(first, "lab")
    send(first, "lab", damaged, again(0))
    getattr(first, end)()
    with sqlite3.connect(tmp_path / "data" / "sessions.sqlite") as connection:
        connection.execute("UPDATE sessions SET state = x'00112233445566778899' WHERE id = ?", [damaged])
    connection.close()
    second = Server(tmp_path, settings=settings).wait()
    try:
        listed = {item["id"]: item for item in second.client.get("/v1/maps/lab/sessions").json()["items"]}
        for name, session in sessions.items():
            assert (listed[session]["restored"], listed[session]["frames"]) == (True, 4)
            repeated = send(second, "lab", session, again(3), frame=3)
            assert repeated["repeated"] and repeated["candidates"] == before[name]["candidates"]
            read = second.client.get(f"/v1/maps/lab/sessions/{session}").json()
            was = {one["place"]["id"]: one["probability"] for one in before[name]["candidates"]}
            now = {one["place"]["id"]: one["probability"] for one in read["belief"]["candidates"]}
            assert now == pytest.approx(was, abs=1e-3)
            answer = send(second, "lab", session, again(6), frame=6)
            assert (answer["restored"], answer["frames_lost"], answer["frames"]) == (True, 2, 5)
        assert_problem(post(second, "lab", damaged, again(1)), 410, "session-expired")
    finally:
        assert second.stop() == 0
