"""Queries of several maps, and of rigs of cameras, over HTTP."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from tests.service.damage import damage
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again, stranger
from tests.service.server import Server, assert_item_problem, assert_problem, text, typed
from tests.service.wire import eventually

HALL, YARD = range(8), range(20, 28)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service with a hall, a yard of another encoder, a twin of a part of the hall, and a damaged map."""
    folder = tmp_path_factory.mktemp("fleet")
    install_coarse_encoder(folder / "models")
    server = Server(folder).wait()
    for name, encoder in (("hall", "m-region-vlad"), ("yard", COARSE), ("twin", "m-region-vlad"), ("bad", COARSE)):
        server.create_map(name, encoder=encoder)
    for number in HALL:
        server.enrol("hall", f"h{number}", jpeg(number), x=10 * number, y=0, heading=0)
    for number in YARD:
        server.enrol("yard", f"y{number}", jpeg(number), x=10 * number, y=0)
    for number in (0, *range(60, 67)):
        server.enrol("twin", f"t{number}", jpeg(number), x=10 * number, y=0)
    server.enrol("bad", "b", jpeg(1))
    assert server.stop() == 0
    damage(server.data_dir, "bad")
    server = Server(folder).wait()
    yield server
    assert server.stop() == 0


def ask(server: Server, data: bytes, **parameters: object) -> dict[str, Any]:
    response = server.client.post("/v1/query", params=text(parameters), content=data, headers=typed(data))
    assert response.status_code == 200, response.text
    answer: dict[str, Any] = response.json()
    return answer


def reviewed(server: Server, map_id: str, frames: int) -> list[str]:
    """The verdicts of a map's kept frames, as soon as there are so many."""
    assert eventually(lambda: server.client.get(f"/v1/maps/{map_id}/review").json()["frames"] >= frames)
    return [one["answer"]["verdict"] for one in server.client.get(f"/v1/maps/{map_id}/review").json()["items"]]


@pytest.mark.thorough
def test_a_frame_that_one_map_recognizes_is_kept_for_review_by_no_other(fleet: Server) -> None:
    every = {"review": {"verdicts": ["recognized", "ambiguous", "unknown"]}}
    for name in ("hall", "yard"):
        assert fleet.client.patch(f"/v1/maps/{name}", json=every).is_success
    try:
        known, foreign = again(3), encoded(stranger(900))
        assert ask(fleet, known, maps="hall,yard")["map"] == "hall"
        assert ask(fleet, foreign, maps="hall,yard")["verdict"] == "unknown"
        assert reviewed(fleet, "hall", 2) == ["unknown", "recognized"]
        assert reviewed(fleet, "yard", 1) == ["unknown"], "the frame of the hall is in no doubt"
    finally:
        for name in ("hall", "yard"):
            fleet.client.patch(f"/v1/maps/{name}", json={"review": None})


def ask_rig(server: Server, frames: dict[str, bytes], **fields: object) -> dict[str, Any]:
    files = [(name, (name, data, "image/jpeg")) for name, data in frames.items()]
    response = server.client.post("/v1/query", files=files, data=text(fields))
    assert response.status_code == 200, response.text
    answer: dict[str, Any] = response.json()
    return answer


def again(number: int, seed: int = 0) -> bytes:
    return encoded(seen_again(scene(number), seed))


def by_map(answer: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {report["map"]: report for report in answer["maps"]}


def test_the_map_that_has_the_place_answers(fleet: Server) -> None:
    answer = ask(fleet, again(3), maps="yard,hall")
    assert (answer["verdict"], answer["map"], answer["place"]["id"]) == ("recognized", "hall", "h3")
    assert answer["pose"]["x"] == pytest.approx(30, abs=0.5)
    assert [report["map"] for report in answer["maps"]] == ["yard", "hall"]
    reports = by_map(answer)
    assert reports["hall"]["verdict"] == "recognized" and reports["hall"]["encoder"].startswith("m-region-vlad@")
    assert reports["yard"]["encoder"].startswith(COARSE + "@")
    alone = fleet.query("hall", again(3))
    assert reports["hall"]["score"] == pytest.approx(alone["score"], abs=1e-4)
    assert answer["frames"] == [
        {"frame": "image", "camera": None, "status": 200, "regions": answer["frames"][0]["regions"], "problem": None}
    ]
    assert answer["frames"][0]["regions"] > 0
    first = answer["matches"][0]
    assert (first["rank"], first["map"], first["place"]["id"]) == (1, "hall", "h3")
    assert [match["rank"] for match in answer["matches"]] == [1, 2, 3, 4, 5]


def test_a_damaged_and_an_unknown_map_are_reported_beside_the_others(fleet: Server) -> None:
    answer = ask(fleet, again(3), maps="bad,hall,never")
    assert (answer["verdict"], answer["map"]) == ("recognized", "hall")
    reports = by_map(answer)
    assert_item_problem(reports["bad"], 503, "map-quarantined")
    assert_item_problem(reports["never"], 404, "unknown-map")
    assert reports["bad"]["verdict"] is None and reports["hall"]["problem"] is None
    none = ask(fleet, again(3), maps="bad,never")
    assert (none["verdict"], none["place"], none["matches"]) == ("unknown", None, [])


def test_all_maps_if_none_is_named(fleet: Server) -> None:
    answer = ask(fleet, again(3))
    assert [report["map"] for report in answer["maps"]] == ["bad", "hall", "twin", "yard"]
    assert answer["map"] == "hall" and by_map(answer)["bad"]["status"] == 503


def test_a_place_that_two_maps_have_is_ambiguous(fleet: Server) -> None:
    answer = ask(fleet, again(0), maps="hall,twin")
    assert {report["verdict"] for report in answer["maps"]} == {"recognized"}
    assert (answer["verdict"], answer["map"], answer["place"], answer["pose"]) == ("ambiguous", None, None, None)
    assert {match["map"] for match in answer["matches"][:2]} == {"hall", "twin"}
    if answer["probability"] is not None:
        assert answer["probability"] <= 0.55
    one = ask(fleet, again(0), maps="hall")
    assert one["verdict"] == "recognized"


@pytest.mark.thorough
def test_one_geographic_place_in_two_maps_is_recognized(server: Server) -> None:
    for name in ("by-day", "by-night"):
        server.create_map(name)
        for number in range(8):
            server.enrol(name, f"p{number}", jpeg(number), latitude=48 + 0.001 * number, longitude=11)
    answer = ask(server, again(2), maps="by-day,by-night")
    assert answer["verdict"] == "recognized" and answer["place"]["id"] == "p2"
    assert answer["pose"]["latitude"] == pytest.approx(48.002)


def test_filters_hold_for_every_map(fleet: Server) -> None:
    answer = ask(fleet, again(3), maps="hall,yard", x=30, y=0, radius=11, k=100)
    assert {match["place"]["id"] for match in answer["matches"]} == {"h2", "h3", "h4"}
    assert by_map(answer)["yard"]["reason"] == "no-place-allowed"
    assert by_map(answer)["yard"]["verdict"] == "unknown"


def test_a_blank_camera_is_ignored(fleet: Server) -> None:
    answer = ask_rig(fleet, {"front": again(3), "left": encoded(blank(320, 240))}, maps="hall")
    assert (answer["verdict"], answer["place"]["id"]) == ("recognized", "h3")
    assert [(frame["frame"], frame["regions"] > 0) for frame in answer["frames"]] == [("front", True), ("left", False)]
    alone = ask(fleet, again(3), maps="hall")
    assert answer["probability"] == pytest.approx(alone["probability"]), "the blank one says nothing"
    nothing = ask_rig(fleet, {"front": encoded(blank()), "left": encoded(blank())}, maps="hall")
    assert (nothing["verdict"], nothing["maps"][0]["reason"]) == ("unknown", "no-regions")


def test_a_bad_frame_fails_alone(fleet: Server) -> None:
    answer = ask_rig(fleet, {"front": again(3), "left": b"plainly no picture"}, maps="hall")
    assert (answer["verdict"], answer["place"]["id"]) == ("recognized", "h3")
    frames = {frame["frame"]: frame for frame in answer["frames"]}
    assert_item_problem(frames["left"], 422, "not-an-image")
    cut = again(3)
    answer = ask_rig(fleet, {"front": again(3), "left": cut[: len(cut) // 2]}, maps="hall")
    assert answer["verdict"] == "recognized"
    assert {frame["frame"]: frame["status"] for frame in answer["frames"]} == {"front": 200, "left": 422}


@pytest.fixture(scope="module")
def rig_map(server: Server) -> str:
    """Two cameras' frames of each of six places, under one pose each; the left camera's look alike everywhere."""
    server.create_map("rig")
    for number in range(6):
        for camera, picture in (("front", jpeg(number)), ("left", jpeg(200 + number))):
            response = server.enrol("rig", f"{camera}-{number}", picture, x=10 * number, y=0)
            assert response.status_code == 201, response.text
    mask = {"polygons": [[[0, 0], [1, 0], [1, 0.1], [0, 0.1]]]}
    assert server.client.put("/v1/maps/rig/cameras/dashed", json={"mask": mask}).status_code in (200, 201)
    return "rig"


@pytest.mark.thorough
def test_two_cameras_are_more_certain_than_one(server: Server, rig_map: str) -> None:
    both = ask_rig(server, {"a": again(4), "b": again(204)}, maps=rig_map, k=4)
    assert both["verdict"] == "recognized" and both["place"]["pose"]["x"] == 40
    assert {match["place"]["id"] for match in both["matches"][:2]} == {"front-4", "left-4"}
    assert both["pose"]["x"] == pytest.approx(40, abs=0.5)
    singles = [ask(server, data, maps=rig_map)["probability"] for data in (again(4), again(204))]
    if all(single is not None for single in singles):
        assert both["probability"] >= max(singles) - 0.02


def test_cameras_that_contradict_each_other_are_not_believed(server: Server, rig_map: str) -> None:
    answer = ask_rig(server, {"a": again(1), "b": again(204)}, maps=rig_map)
    assert answer["verdict"] != "recognized"
    for verify in ("auto", "always"):
        (report,) = ask_rig(server, {"a": again(1), "b": again(204)}, maps=rig_map, verify=verify)["maps"]
        assert report["verdict"] == "ambiguous", verify
        rivals = {place for group in report["rivals"] for place in group["places"]}
        assert rivals <= {"front-1", "left-4"} and rivals


def test_the_cameras_of_a_rig_are_verified(server: Server, rig_map: str) -> None:
    frames = {"a": again(4), "b": again(204)}
    states = {}
    for verify in ("never", "auto", "always"):
        answer = ask_rig(server, frames, maps=rig_map, verify=verify)
        assert answer["verdict"] == "recognized" and answer["place"]["pose"]["x"] == 40
        (states[verify],) = [report["verification"] for report in answer["maps"]]
    assert states["never"]["state"] == "never" and states["always"]["state"] == "verified"
    assert states["auto"]["state"] in ("verified", "not-needed")
    assert states["always"]["candidates"] > 1


def test_each_part_may_name_its_camera(server: Server, rig_map: str) -> None:
    named = ask_rig(server, {"a": again(4), "b": again(204)}, maps=rig_map, cameras={"a": "dashed"})
    assert {frame["frame"]: frame["camera"] for frame in named["frames"]} == {"a": "dashed", "b": None}
    assert named["place"] is not None and named["place"]["pose"]["x"] == 40
    unknown = ask_rig(server, {"a": again(4)}, maps=f"{rig_map},traverse", cameras={"a": "dashed"})
    assert unknown["verdict"] in {"recognized", "ambiguous"}


def test_invalid_queries_of_several_maps(fleet: Server) -> None:
    data = jpeg(1)

    def problem(status: int, slug: str, **parameters: object) -> None:
        response = fleet.client.post("/v1/query", params=text(parameters), content=data, headers=typed(data))
        assert_problem(response, status, slug)

    problem(422, "invalid-identifier", maps="")
    problem(422, "invalid-identifier", maps="Hall")
    problem(422, "invalid-request", maps="hall,hall")
    problem(422, "invalid-request", maps=",".join(f"m{number}" for number in range(101)))
    problem(422, "invalid-request", x=1, y=1)
    problem(422, "invalid-request", cameras={"image": "front"})
    problem(422, "invalid-request", k=0)
    problem(422, "invalid-request", colour="red")
    files = [("a", ("a", data, "image/jpeg"))]
    for fields in ({"cameras": "[]"}, {"cameras": json.dumps({"b": "front"})}, {"cameras": '{"a": 1}'}):
        assert_problem(fleet.client.post("/v1/query", files=files, data=fields), 422, "invalid-request")
    twice = [*files, ("a", ("a2", data, "image/jpeg"))]
    assert_problem(fleet.client.post("/v1/query", files=twice), 422, "invalid-request")
    many = [(f"c{number}", (f"c{number}", data, "image/jpeg")) for number in range(17)]
    assert_problem(fleet.client.post("/v1/query", files=many), 422, "invalid-request")
    bad = [("a", ("a", b"plainly no picture", "image/jpeg"))]
    assert_problem(fleet.client.post("/v1/query", files=bad), 422, "not-an-image")
    assert_problem(fleet.client.post("/v1/query", content=b"{}"), 415, "unsupported-media-type")


@pytest.mark.thorough
def test_answers_count_for_the_health_of_the_map_that_has_the_place(fleet: Server) -> None:
    def counted(map_id: str) -> tuple[int, int]:
        answers = fleet.client.get(f"/v1/maps/{map_id}/health").json()["answers"]
        return answers["queries"], answers["recognized"]

    before = {name: counted(name) for name in ("hall", "twin")}
    assert ask(fleet, again(5), maps="hall,twin")["map"] == "hall"
    assert ask(fleet, encoded(stranger(63)), maps="hall")["verdict"] == "unknown"
    assert ask(fleet, encoded(blank()), maps="hall")["verdict"] == "unknown"
    assert ask(fleet, encoded(stranger(40)), maps="hall,twin")["verdict"] == "unknown", "nowhere, so of no map"
    assert counted("hall") == (before["hall"][0] + 3, before["hall"][1] + 1)
    assert counted("twin") == before["twin"]
