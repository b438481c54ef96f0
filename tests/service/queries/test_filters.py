"""Queries with filters, soft priors and the robot's own last frames, over HTTP."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest

from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem, text, typed

PLACES = 8


@pytest.fixture(scope="module")
def yard(server: Server) -> str:
    """Places ten metres apart, turned by 45° each, over two traverses and two floors, a minute apart."""
    server.create_map("yard")
    for number in range(PLACES):
        response = server.enrol(
            "yard", f"p{number}", jpeg(number), x=10 * number, y=0, heading=45 * number,
            sequence="monday" if number < 4 else "tuesday, late", timestamp=f"2026-11-20T10:0{number}:00Z",
            metadata={"floor": number % 2, "light": "day" if number < 2 else "night"},
        )  # fmt: skip
        assert response.status_code == 201, response.text
    return "yard"


def test_areas_of_the_other_kind_are_refused(server: Server, yard: str, islands: str) -> None:
    degrees: dict[str, object] = {"latitude": -17, "longitude": 180, "radius": 50}
    metres: dict[str, object] = {"x": 1, "y": 1, "radius": 50}
    for map_id, area, kind in (
        (yard, degrees, "geographic"), (yard, {"bbox": "1,1,2,2"}, "geographic"), (islands, metres, "metric"),
        (yard, degrees | {"soft": "position"}, "geographic"),
    ):  # fmt: skip
        sent = server.client.post(
            f"/v1/maps/{map_id}/query", params=text(area), content=jpeg(1), headers=typed(jpeg(1))
        )
        assert f"has {kind} coordinates" in assert_problem(sent, 409, "mixed-coordinates")["detail"]
    params = text(metres | {"id": "new"})
    close = server.client.post(
        f"/v1/maps/{islands}/query:enrol", params=params, content=jpeg(99), headers=typed(jpeg(1))
    )
    assert_problem(close, 409, "mixed-coordinates")
    both = server.client.post(
        "/v1/query", params=text(metres | {"maps": "yard,islands"}), content=jpeg(1), headers=typed(jpeg(1))
    )
    reports = {one["map"]: one for one in both.json()["maps"]}
    assert reports["yard"]["problem"] is None and reports["islands"]["problem"]["type"].endswith("mixed-coordinates")


@pytest.fixture(scope="module")
def islands(server: Server) -> str:
    """Places around the antimeridian."""
    server.create_map("islands")
    for number, longitude in enumerate((179.999, 180.0, -179.999, 170.0)):
        heading = (350 + 5 * number) % 360
        response = server.enrol(
            "islands", f"p{number}", jpeg(number), latitude=-17, longitude=longitude, heading=heading
        )
        assert response.status_code == 201, response.text
    return "islands"


Find = Callable[..., set[str]]


@pytest.fixture
def find(server: Server, yard: str) -> Find:
    def ids(**parameters: object) -> set[str]:
        answer = server.query(yard, jpeg(3), k=100, **parameters)
        return {match["place"]["id"] for match in answer["matches"]}

    return ids


def numbers(*which: int) -> set[str]:
    return {f"p{number}" for number in which}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({"x": 30, "y": 0, "radius": 10}, (2, 3, 4)),
        ({"x": 30, "y": 3, "radius": 0}, ()),
        ({"heading": 0, "heading_tolerance": 45}, (0, 1, 7)),
        ({"heading": -45, "heading_tolerance": 0}, (7,)),
        ({"sequences": "monday"}, (0, 1, 2, 3)),
        ({"sequences": '["tuesday, late"]'}, (4, 5, 6, 7)),
        ({"sequences": "monday,never"}, (0, 1, 2, 3)),
        ({"after": "2026-11-20T10:03:00Z", "before": "2026-11-20T11:05:00+01:00"}, (3, 4, 5)),
        ({"where": {"floor": 1}}, (1, 3, 5, 7)),
        ({"where": {"floor": 1.0, "light": "day"}}, (1,)),
        ({"where": {"floor": True}}, ()),
        ({"where": {"floor": 0}, "sequences": "monday", "x": 20, "y": 0, "radius": 11}, (2,)),
        ({"sequence": "tuesday, late", "exclude_frames": 3}, (0, 1, 2, 3, 4)),
        ({"sequence": "never", "exclude_frames": 3}, range(PLACES)),
        ({"sequence": "tuesday, late", "timestamp": "2026-11-20T10:07:30Z", "exclude_seconds": 91}, (0, 1, 2, 3, 4, 5)),
    ],
)  # fmt: skip
def test_filters_bound_what_is_found(find: Find, parameters: dict[str, object], expected: tuple[int, ...]) -> None:
    assert find(**parameters) == numbers(*expected)


def test_a_filter_that_allows_nothing_is_answered(server: Server, yard: str) -> None:
    answer = server.query(yard, jpeg(3), x=1000, y=0, radius=1)
    assert (answer["verdict"], answer["reason"]) == ("unknown", "no-place-allowed")
    assert answer["matches"] == [] and answer["score"] is None and answer["probability"] is None


def test_the_place_is_found_among_those_allowed(server: Server, yard: str) -> None:
    answer = server.query(yard, encoded(seen_again(scene(3))), x=28, y=1, radius=15, where={"floor": 1})
    assert answer["verdict"] == "recognized" and answer["place"]["id"] == "p3"
    elsewhere = server.query(yard, encoded(seen_again(scene(3))), x=60, y=0, radius=15)
    assert elsewhere["verdict"] != "recognized"
    assert {match["place"]["id"] for match in elsewhere["matches"]} == numbers(5, 6, 7)


def test_around_the_antimeridian(server: Server, islands: str) -> None:
    def ids(**parameters: object) -> set[str]:
        found = server.query(islands, jpeg(0), k=10, **parameters)["matches"]
        return {match["place"]["id"] for match in found}

    assert ids(bbox="179.9,-18,-179.9,-16") == numbers(0, 1, 2)
    assert ids(bbox="169,-18,171,-16") == numbers(3)
    assert ids(latitude=-17, longitude=-180, radius=150) == numbers(0, 1, 2)
    assert ids(latitude=-17, longitude=-180, radius=50) == numbers(1)


def test_a_filter_follows_edits_of_places(server: Server, map_id: str) -> None:
    def ids(**parameters: object) -> list[str]:
        return [match["place"]["id"] for match in server.query(map_id, jpeg(1), **parameters)["matches"]]

    server.enrol(map_id, "a", jpeg(1), x=0, y=0, heading=10, timestamp="2026-01-01T00:00:00Z", metadata={"n": 1})
    assert ids(where={"n": 1}) == ids(x=0, y=0, radius=1) == ids(heading=10, heading_tolerance=1) == ["a"]
    path = f"/v1/maps/{map_id}/places/a"
    changes = {"metadata": {"n": 2}, "pose": {"x": 50, "heading": 200}, "timestamp": "2026-07-01T00:00:00Z"}
    assert server.client.patch(path, json=changes).status_code == 200
    assert ids(where={"n": 1}) == ids(x=0, y=0, radius=1) == ids(before="2026-06-01") == []
    assert ids(where={"n": 2}, x=50, y=0, radius=1, heading=190, heading_tolerance=20, after="2026-06-01") == ["a"]
    server.enrol(map_id, "a", jpeg(2), metadata={"n": 3})
    assert ids(where={"n": 2}) == [] and ids(where={"n": 3}) == ["a"]
    assert server.client.delete(path).status_code == 204
    assert server.query(map_id, jpeg(1), where={"n": 3})["reason"] == "empty-map"


def test_a_soft_prior_chooses_among_places_that_look_alike(server: Server, map_id: str) -> None:
    for place, x in (("here", 0), ("there", 500)):
        server.enrol(map_id, place, jpeg(1), x=x, y=0)
    for number in range(10, 18):
        server.enrol(map_id, f"p{number}", jpeg(number), x=100 * number, y=0)
    frame = encoded(seen_again(scene(1)))
    assert server.query(map_id, frame)["verdict"] == "ambiguous"
    for place, x in (("here", 3), ("there", 495)):
        answer = server.query(map_id, frame, x=x, y=0, radius=20, soft="position")
        assert answer["verdict"] == "recognized" and answer["place"]["id"] == place
        weights = {match["place"]["id"]: match["weight"] for match in answer["matches"]}
        assert weights[place] > 0.9 and weights["there" if place == "here" else "here"] == pytest.approx(0.1, abs=0.01)
        assert len(answer["matches"]) == 5, "nothing is ruled out"


def test_a_soft_prior_adds_no_certainty_and_a_carried_robot_is_found(server: Server, yard: str) -> None:
    frame = encoded(seen_again(scene(3)))
    plain = server.query(yard, frame)
    assert all(match["weight"] is None for match in plain["matches"])
    carried = server.query(yard, frame, x=5000, y=0, radius=5, soft="position", prior_trust=0.9)
    assert carried["place"] is not None and carried["place"]["id"] == "p3"
    assert carried["score"] == pytest.approx(plain["score"]) and carried["decision"] < plain["decision"]
    agrees = server.query(yard, frame, x=30, y=0, radius=5, soft="position")
    assert agrees["place"]["id"] == "p3" and agrees["matches"][0]["weight"] == pytest.approx(1)
    assert agrees["probability"] is None or agrees["probability"] >= carried["probability"]


def test_every_kind_may_be_soft(server: Server, islands: str) -> None:
    answer = server.query(
        islands, jpeg(3), k=100, latitude=-17, longitude=180, radius=5, heading=0, heading_tolerance=9, bbox="0,0,1,1",
        sequences="monday", after="2026-11-20T10:03:00Z", where={"floor": 1}, prior_trust=0.5,
        soft="position,heading,bbox,sequences,time,where",
    )  # fmt: skip
    assert len(answer["matches"]) == 4
    assert {match["weight"] for match in answer["matches"]} == {0.5}, "no place is in the box"


def test_a_level_is_a_prior_and_levels_are_a_filter(server: Server, yard: str) -> None:
    """The yard's levels are those of its metadata."""
    stated = server.query(yard, jpeg(3), k=8, level=1)["matches"]
    assert {match["place"]["id"]: match["weight"] for match in stated} == {
        f"p{number}": pytest.approx(1.0 if number % 2 else 0.1) for number in range(PLACES)
    }
    assert {match["weight"] for match in server.query(yard, jpeg(3), k=8, level=1, prior_trust=0.5)["matches"]} == {
        0.5,
        1,
    }
    filtered = server.query(yard, jpeg(3), k=8, levels="1,roof")["matches"]
    assert {match["place"]["id"] for match in filtered} == numbers(1, 3, 5, 7)
    assert server.query(yard, jpeg(3), levels='["roof"]')["reason"] == "no-place-allowed"
    soft = server.query(yard, jpeg(3), k=8, levels="1", soft="levels")["matches"]
    assert [match["weight"] for match in soft] == [match["weight"] for match in stated]


def test_a_batch_is_filtered_like_a_query(server: Server, yard: str) -> None:
    files = [("a", ("a", jpeg(3), "image/jpeg")), ("b", ("b", jpeg(5), "image/jpeg"))]
    response = server.client.post(
        f"/v1/maps/{yard}/query:batch", params={"k": 8}, files=files, data={"where": '{"floor": 1}'}
    )
    assert response.status_code == 200, response.text
    for item in response.json()["items"]:
        assert {match["place"]["id"] for match in item["answer"]["matches"]} == numbers(1, 3, 5, 7)


def test_the_pose_is_estimated_where_a_place_is_recognized(server: Server, yard: str, islands: str) -> None:
    answer = server.query(yard, encoded(seen_again(scene(3))), verify="never")
    pose = answer["pose"]
    assert (pose["x"], pose["y"]) == (pytest.approx(30), pytest.approx(0))
    assert "z" not in pose and "latitude" not in pose
    assert pose["heading"] == pytest.approx(135, abs=0.1) and pose["heading_spread"] is None
    assert pose["spread"] == pytest.approx(8) and pose["places"] == 1, "the next place of its floor is 20 m away"
    elsewhere = server.query(yard, encoded(seen_again(scene(3))), x=60, y=0, radius=15)
    assert elsewhere["verdict"] != "recognized" and elsewhere["pose"] is None
    pose = server.query(islands, encoded(seen_again(scene(1))), k=1)["pose"]
    assert pose["latitude"] == pytest.approx(-17) and abs(pose["longitude"]) == pytest.approx(180) and "x" not in pose


@pytest.mark.parametrize(
    "parameters",
    [
        {"radius": 5},
        {"x": 1, "y": 1},
        {"x": 1, "radius": 5},
        {"x": 1, "y": 1, "latitude": 1, "longitude": 1, "radius": 5},
        {"x": 1, "y": 1, "radius": -1},
        {"x": 1, "y": 1, "radius": "nan"},
        {"heading": 10},
        {"heading_tolerance": 10},
        {"heading": 10, "heading_tolerance": 181},
        {"bbox": "1,2,3"},
        {"bbox": "1,2,3,x"},
        {"bbox": "0,10,1,5"},
        {"bbox": "-181,0,0,1"},
        {"bbox": "1e1,0,20,1"},
        {"sequences": ""},
        {"levels": ""},
        {"levels": "a/b"},
        {"level": "x" * 33},
        {"sequences": "a,,b"},
        {"sequences": "[1]"},
        {"sequences": '["a"'},
        {"sequences": ",".join("abcdefghij"[i % 10] * (1 + i // 10) for i in range(101))},
        {"after": "yesterday"},
        {"after": "2026-01-02", "before": "2026-01-01"},
        {"where": "[]"},
        {"where": "{}"},
        {"where": "{"},
        {"where": '{"a": [1]}'},
        {"where": '{"a": NaN}'},
        {"where": '{"a": 1e999}'},
        {"where": '{"a": "\\ud800"}'},
        {"where": json.dumps({"a": "x" * 513})},
        {"soft": "position"},
        {"soft": "colour", "x": 1, "y": 1, "radius": 1},
        {"prior_trust": 0.5, "x": 1, "y": 1, "radius": 1},
        {"soft": "position", "prior_trust": 1, "x": 1, "y": 1, "radius": 1},
        {"exclude_frames": 3},
        {"exclude_seconds": 3, "sequence": "monday"},
        {"exclude_frames": -1, "sequence": "monday"},
    ],
)
def test_invalid_filters(server: Server, yard: str, parameters: dict[str, object]) -> None:
    data = jpeg(1)
    response = server.client.post(
        f"/v1/maps/{yard}/query", params={k: str(v) for k, v in parameters.items()}, content=data, headers=typed(data)
    )
    assert_problem(response, 422, "invalid-request")
