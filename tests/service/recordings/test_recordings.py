"""A bag that is uploaded in pieces and enrolled by a job: as by the command, after breaks, and if it cannot be."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest

from placerec_client import Client
from placerec_client.problems import RecordingOffset, UnknownRecording
from service.access.keys import Keys
from tests.core.recordings.bags import (
    CAMERA,
    ODOMETRY,
    SECOND,
    START,
    WRITERS,
    camera_info,
    compressed,
    fix,
    image,
    moved,
    walk,
    write_mcap,
    write_ros1,
)
from tests.service.commands.conftest import Placerec, placerec
from tests.service.map_jobs import finished, places, reaching, wait_until
from tests.service.scenes import encoded, jpeg, scene
from tests.service.server import Server

__all__ = ["placerec"]

SEEN = {
    "width": 160, "height": 120, "fx": 75.0, "fy": 75.0, "cx": 79.5, "cy": 59.5,
    "distortion_model": "plumb_bob", "distortion": [-0.2, 0.05, 0.001, 0.0, 0.0],
}  # fmt: skip
"""The intrinsics of ``camera_info``."""

ORDER = {"sequence": "monday", "pose_topic": ODOMETRY, "keep_standing": True}


@pytest.fixture(scope="module")
def taking(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    server = Server(tmp_path_factory.mktemp("taking"), {"max_recording_bytes": 2 << 20}).wait()
    yield server
    assert server.stop() == 0


OCTETS = "application/octet-stream"


def put(server: Server, map_id: str, name: str, offset: int, data: bytes, kind: str = OCTETS) -> Any:
    path = f"/v1/maps/{map_id}/recordings/{name}"
    return server.client.put(path, params={"offset": offset}, content=data, headers={"Content-Type": kind})


def slug(answer: httpx.Response) -> str:
    return str(answer.json()["type"]).rpartition(":")[2]


def enrolled(server: Server, map_id: str, name: str, **order: Any) -> dict[str, Any]:
    accepted = server.client.post(f"/v1/maps/{map_id}/recordings/{name}", json=order)
    assert accepted.status_code == 202, accepted.text
    return finished(server, accepted.json())


def test_dates_that_are_yet_to_come_are_left_out(taking: Server, placerec: Placerec, tmp_path: Path) -> None:
    years = 10 * 31_557_600 * SECOND
    bag = write_mcap(tmp_path / "later.mcap", [compressed(START + years + n * SECOND, jpeg(n)) for n in range(3)])
    taking.create_map("later")
    put(taking, "later", "later.mcap", 0, bag.read_bytes())
    result = enrolled(taking, "later", "later.mcap", keep_standing=True)["result"]
    (remark,) = result["remarks"]
    assert result["changes"] == {"created": 3} and "3 of 3 frames have dates more than a day ahead" in remark
    taking.create_map("later-by-command")
    told = placerec("enrol", bag, "--map", "later-by-command", "--keep-standing", "--url", taking.client.base_url)
    assert "3 of 3 frames have dates more than a day ahead" in " ".join(told.stderr.split())
    for map_id in ("later", "later-by-command"):
        assert [one["timestamp"] for one in taking.places(map_id).values()] == [None] * 3


def test_a_bag_in_pieces_becomes_the_places_that_the_command_line_makes_of_it(
    taking: Server, placerec: Placerec, tmp_path: Path
) -> None:
    bag = write_mcap(tmp_path / "walk.mcap", walk())
    data = bag.read_bytes()
    taking.create_map("pieces")
    half = len(data) // 2
    assert put(taking, "pieces", "walk.mcap", 0, data[:half]).json() == {"id": "walk.mcap", "bytes": half}
    refused = put(taking, "pieces", "walk.mcap", 0, data)
    assert (refused.status_code, slug(refused)) == (409, "recording-offset") and str(half) in refused.json()["detail"]
    assert taking.client.get("/v1/maps/pieces/recordings/walk.mcap").json()["bytes"] == half
    assert put(taking, "pieces", "walk.mcap", half, data[half:]).json()["bytes"] == len(data)
    job = enrolled(taking, "pieces", "walk.mcap", **ORDER)
    assert job["state"] == "succeeded" and job["resumable"], job
    result = job["result"]
    assert result["changes"] == {"created": 6} and result["failed"] == {"count": 0, "items": []}
    assert {name: result[name] for name in ("sequence", "frames", "chosen", "posed", "remarks")} == {
        "sequence": "monday", "frames": 6, "chosen": 6, "posed": 6, "remarks": [],
    }  # fmt: skip
    left = taking.client.get("/v1/maps/pieces/recordings/walk.mcap").json()
    assert left["bytes"] == 0, "it is not needed any more"
    taking.create_map("by-command")
    placerec("enrol", bag, "--map", "by-command", "--sequence", "monday", "--pose-topic", ODOMETRY, "--keep-standing",
             "--url", str(taking.client.base_url))  # fmt: skip
    mine, theirs = places(taking, "pieces"), places(taking, "by-command")
    times = ("created_at", "updated_at", "thumbnail")
    for one in [*mine.values(), *theirs.values()]:
        for name in times:
            one.pop(name, None)
    assert mine == theirs and len(mine) == 6


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["mcap-lz4", "ros1"])
def test_other_kinds_of_bags_are_taken_too(taking: Server, kind: str, tmp_path: Path) -> None:
    path = WRITERS[kind](tmp_path, walk())
    with Client(str(taking.client.base_url)) as client:
        lab = client.maps.create(f"kind-{kind}")
        seen: list[int] = []
        name = lab.recordings.upload(path, progress=lambda done, _size: seen.append(done))
        assert seen[-1] == path.stat().st_size == lab.recordings.size(name)
        result = lab.recordings.enrol(name, pose_topic=ODOMETRY, every_metres=2.0, keep_standing=True).wait().result
        assert result and (result["sequence"], result["chosen"], lab.recordings.size(name)) == ("walk", 3, 0)


def test_a_bag_that_loses_its_poses_is_refused_unless_allowed(taking: Server, tmp_path: Path) -> None:
    seen = [compressed(START + n * SECOND, jpeg(n)) for n in range(4)]
    alternating = [moved(START + n * SECOND // 10, n / 10 + 500 * (n % 2), 0.0) for n in range(40)]
    data = write_mcap(tmp_path / "two.mcap", [*seen, *alternating]).read_bytes()
    taking.create_map("losing")
    assert put(taking, "losing", "two.mcap", 0, data).status_code == 200
    problem = enrolled(taking, "losing", "two.mcap", **ORDER)["problem"]
    assert problem["status"] == 422 and problem["type"].endswith(":invalid-trajectory")
    assert "4 of 4 frames lose their pose" in problem["detail"] and "allow_lost_poses" in problem["detail"]
    assert "--" not in problem["detail"] and places(taking, "losing") == {}
    result = enrolled(taking, "losing", "two.mcap", allow_lost_poses=True, **ORDER)["result"]
    assert (result["posed"], result["path"]) == (0, None) and "two publishers" in result["remarks"][0]


def test_a_bag_whose_odometry_begins_anew_gives_two_traverses(taking: Server, tmp_path: Path) -> None:
    seen = [compressed(START + n * SECOND, jpeg(n)) for n in range(4)]
    told = [moved(START + n * SECOND // 10, n - 20.0 * (n >= 20), 0.0) for n in range(40)]
    data = write_mcap(tmp_path / "anew.mcap", [*seen, *told]).read_bytes()
    taking.create_map("anew")
    assert put(taking, "anew", "anew.mcap", 0, data).status_code == 200
    result = enrolled(taking, "anew", "anew.mcap", **ORDER)["result"]
    assert result["sequences"] == ["monday", "monday~2"] and result["posed"] == 2
    assert result["path"] == "path 10 m, extent 10 × 0.0 m, 2 of 4 frames with a pose"
    assert "begins anew" in result["remarks"][0] and "~2" in result["remarks"][1]
    found = [(one["sequence"], one["pose"] is None) for one in places(taking, "anew").values()]
    assert sorted(found) == [("monday", False)] * 2 + [("monday~2", True)] * 2


def test_a_camera_without_intrinsics_gets_those_of_the_bag(taking: Server, placerec: Placerec, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "walk.mcap", [camera_info(START), *walk()])
    cameras = {"unmeasured": {"mask": None}, "measured": {"intrinsics": {**SEEN, "fx": 90.0}}}
    by_bag, by_command = "intrinsics-by-bag", "intrinsics-by-command"
    for map_id in (by_bag, by_command):
        taking.create_map(map_id)
        for name, camera in cameras.items():
            assert taking.client.put(f"/v1/maps/{map_id}/cameras/{name}", json=camera).status_code == 201

    def stored(map_id: str, name: str) -> Any:
        return taking.client.get(f"/v1/maps/{map_id}/cameras/{name}").json()["intrinsics"]

    said = []
    for number, camera in enumerate((None, "measured", "unmeasured")):
        assert put(taking, by_bag, "walk.mcap", 0, path.read_bytes()).status_code == 200
        order = {"sequence": f"s{number}", "id_prefix": f"{number}-", "camera": camera, "keep_standing": True}
        said += [enrolled(taking, by_bag, "walk.mcap", **order)["result"]["remarks"]]
    assert [len(one) for one in said] == [1, 0, 1] and "if one is named" in said[0][0]
    assert said[2] == ["The camera unmeasured had no intrinsics, and has those of the bag now."]
    words = ("enrol", path, "--map", by_command, "--camera", "unmeasured", "--url", taking.client.base_url)
    assert said[2][0] in placerec(*words).stderr
    for map_id in (by_bag, by_command):
        assert stored(map_id, "unmeasured") == SEEN and stored(map_id, "measured")["fx"] == 90.0


def test_a_camera_without_a_range_gets_that_of_a_bag_of_ten_bits(
    taking: Server, placerec: Placerec, tmp_path: Path
) -> None:
    greys = [cv2.cvtColor(scene(number), cv2.COLOR_BGR2GRAY) for number in range(4)]
    ten = [(grey.astype(np.uint16) * 4).tobytes() for grey in greys]
    said = [image(START + n * SECOND, 320, 240, "mono16", data, 640) for n, data in enumerate(ten)]
    path = write_mcap(tmp_path / "ten.mcap", said)
    by_bag, by_command = "range-by-bag", "range-by-command"
    for map_id in (by_bag, by_command):
        taking.create_map(map_id)
        assert taking.client.put(f"/v1/maps/{map_id}/cameras/deep", json={}).status_code == 201
    assert put(taking, by_bag, "ten.mcap", 0, path.read_bytes()).status_code == 200
    result = enrolled(taking, by_bag, "ten.mcap", camera="deep")["result"]
    words = ("enrol", path, "--map", by_command, "--url", taking.client.base_url)
    told = placerec(*words, "--camera", "deep").stderr
    assert result["chosen"] == 4 and len(result["remarks"]) == 1 and result["remarks"][0] in " ".join(told.split())
    assert "The camera deep had no range of values" in result["remarks"][0]
    assert re.search(r"whose values reach only \d+ of 65535", result["remarks"][0])
    for map_id in (by_bag, by_command):
        low, high = taking.client.get(f"/v1/maps/{map_id}/cameras/deep").json()["value_range"]
        assert 0 <= low < 200 and 900 < high <= 1020
        answer = taking.query(map_id, encoded(greys[2], ".png"))
        assert answer["matches"][0]["place"]["id"] == list(places(taking, map_id))[2]
        assert answer["matches"][0]["score"] > 0.9

    refused = placerec(*words, "--sequence", "again", "--id-prefix", "n-", status=1).stderr
    assert "name a camera of the map" in refused and refused.count("and 3 more frames: The frame has no region") == 1


def test_a_bag_is_kept_while_frames_of_it_failed(taking: Server, tmp_path: Path) -> None:
    """What the failures name as the way out needs the bag."""
    greys = [cv2.cvtColor(scene(number), cv2.COLOR_BGR2GRAY) for number in range(3)]
    ten = [(grey.astype(np.uint16) * 4).tobytes() for grey in greys]
    dark = [image(START + n * SECOND, 320, 240, "mono16", data, 640) for n, data in enumerate(ten)]
    torn = compressed(START + 9 * SECOND, b"no picture at all")
    bags = {"none.mcap": dark, "some.mcap": [*(compressed(START + n * SECOND, jpeg(n)) for n in range(3)), torn]}
    taking.create_map("kept")
    for name, said in bags.items():
        data = write_mcap(tmp_path / name, said).read_bytes()
        assert put(taking, "kept", name, 0, data).status_code == 200
        job = enrolled(taking, "kept", name, keep_standing=True)
        if name == "none.mcap":
            problem = job["problem"]
            assert job["state"] == "failed" and problem["type"].endswith(":nothing-enrolled")
            assert "None of the 3 frames became a place" in problem["detail"] and len(problem["errors"]) == 3
            assert problem["errors"][0]["message"] in problem["detail"]
            assert taking.client.put("/v1/maps/kept/cameras/deep", json={}).status_code == 201
            again = {"camera": "deep"}
        else:
            assert job["state"] == "succeeded" and job["result"]["failed"]["count"] == 1
            assert "the uploaded bag is kept" in job["result"]["remarks"][-1]
            again = {}
        assert taking.client.get(f"/v1/maps/kept/recordings/{name}").json()["bytes"] == len(data)
        if again:
            assert enrolled(taking, "kept", name, **again)["result"]["changes"] == {"created": 3}
            assert taking.client.get(f"/v1/maps/kept/recordings/{name}").json()["bytes"] == 0


def test_degrees_are_refused_by_a_map_in_metres_before_a_frame_is_read(
    taking: Server, placerec: Placerec, tmp_path: Path
) -> None:
    taking.create_map("metres")
    taking.enrol("metres", "first", jpeg(1), x=1, y=2, sequence="day")
    said = [*(compressed(START + n * SECOND, jpeg(n)) for n in range(3)),
            *(fix(START + n * SECOND, 49.0 + n * 1e-5, 8.0) for n in range(3))]  # fmt: skip
    bag = write_mcap(tmp_path / "earth.mcap", said)
    assert put(taking, "metres", "earth.mcap", 0, bag.read_bytes()).status_code == 200
    for more in ({}, {"replace": True}):
        problem = enrolled(taking, "metres", "earth.mcap", pose_topic="/fix", keep_standing=True, **more)["problem"]
        assert problem["type"].endswith(":mixed-coordinates") and "a map has one kind" in problem["detail"]
    told = placerec("enrol", bag, "--map", "metres", "--pose-topic", "/fix", "--url", taking.client.base_url, status=1)
    assert "a map has one kind" in told.stderr and "more frames" not in told.stderr and "--sequence" not in told.stderr
    assert list(places(taking, "metres")) == ["first"]


def test_intrinsics_that_are_none_are_told_and_not_stored(taking: Server, tmp_path: Path) -> None:
    taking.create_map("uncalibrated")
    assert taking.client.put("/v1/maps/uncalibrated/cameras/front", json={}).status_code == 201
    data = write_ros1(tmp_path / "walk.bag", [camera_info(START, focal=0.0), *walk()]).read_bytes()
    assert put(taking, "uncalibrated", "walk.bag", 0, data).status_code == 200
    (remark,) = enrolled(taking, "uncalibrated", "walk.bag", camera="front", keep_standing=True)["result"]["remarks"]
    assert "/camera/camera_info is not used" in remark and "fx" in remark
    assert taking.client.get("/v1/maps/uncalibrated/cameras/front").json()["intrinsics"] is None


@pytest.mark.thorough
def test_frames_in_which_nothing_changes_are_left_out(taking: Server, tmp_path: Path) -> None:
    said = [compressed(START + number * SECOND, jpeg(number // 3)) for number in range(9)]
    data = write_mcap(tmp_path / "standing.mcap", said).read_bytes()
    taking.create_map("standing")
    assert put(taking, "standing", "standing.mcap", 0, data).status_code == 200
    result = enrolled(taking, "standing", "standing.mcap")["result"]
    assert result["changes"] == {"created": 3} and result["posed"] == 0
    assert result["remarks"] == ["6 of 9 frames show the same as the one before them."]


@pytest.mark.thorough
def test_what_does_not_fit_is_told_and_the_bag_stays_for_another_try(taking: Server, tmp_path: Path) -> None:
    said = [*walk(), compressed(START, jpeg(40), topic="/rear/compressed")]
    data = write_ros1(tmp_path / "two.bag", said).read_bytes()
    taking.create_map("tries")
    assert put(taking, "tries", "two.bag", 0, data).status_code == 200
    for order, kind, told in (
        ({}, "unknown-topic", CAMERA),
        ({}, "unknown-topic", "Name one with topic."),
        ({"topic": "/none"}, "unknown-topic", "/none"),
        ({"topic": CAMERA, "pose_topic": "/none"}, "unknown-topic", ODOMETRY),
        ({"topic": "/rear/compressed", "every_metres": 1.0}, "invalid-recording", "No frame has the pose"),
    ):
        problem = enrolled(taking, "tries", "two.bag", **order)["problem"]
        assert problem["type"].endswith(kind) and told in problem["detail"], problem
        assert str(taking.data_dir) not in problem["detail"], "where the service keeps it is of no use to its sender"
    assert enrolled(taking, "tries", "two.bag", topic=CAMERA, **ORDER)["result"]["changes"] == {"created": 6}
    # The same frames as another traverse would take these places away from it.
    assert put(taking, "tries", "two.bag", 0, data).status_code == 200
    problem = enrolled(taking, "tries", "two.bag", topic=CAMERA, sequence="tuesday")["problem"]
    assert problem["type"].endswith("places-taken") and "in the traverse 'monday', with these very" in problem["detail"]
    again = enrolled(taking, "tries", "two.bag", topic=CAMERA, sequence="tuesday", id_prefix="t-", keep_standing=True)
    assert again["result"]["changes"] == {"created": 6}


@pytest.mark.thorough
def test_another_bag_replaces_nothing_unless_it_is_to(taking: Server, tmp_path: Path) -> None:
    """Ids are made of stamps: of a robot without a clock, every bag begins at the same."""
    taking.create_map("stamped")

    def enrol(pictures: int, after: int = 0, **order: Any) -> dict[str, Any]:
        said = [compressed(START + (after + n) * SECOND, jpeg(pictures + n)) for n in range(3)]
        data = write_mcap(tmp_path / "walk.mcap", said).read_bytes()
        taking.client.delete("/v1/maps/stamped/recordings/walk.mcap")  # one whose job failed is still there
        assert put(taking, "stamped", "walk.mcap", 0, data).status_code == 200
        return enrolled(taking, "stamped", "walk.mcap", keep_standing=True, **order)

    assert enrol(10)["result"]["changes"] == {"created": 3}
    problem = enrol(20)["problem"]
    assert problem["type"].endswith("places-taken")
    assert "3 of 3 frames exist already in the traverse 'walk', with other pictures." in problem["detail"]
    again = enrol(10)["result"]
    assert (again["changes"], again["sequence"], again["remarks"]) == ({"unchanged": 3}, "walk", [])
    later = enrol(30, after=60)["result"]
    assert (later["changes"], later["sequence"]) == ({"created": 3}, "walk~2")
    assert later["remarks"] == ["The map has a traverse walk already; these frames are in walk~2."]
    assert enrol(20, replace=True)["result"]["changes"] == {"replaced": 3}


@pytest.mark.thorough
def test_a_file_that_is_no_bag_and_what_is_left_of_one(taking: Server, tmp_path: Path) -> None:
    taking.create_map("torn")
    assert put(taking, "torn", "no.mcap", 0, b"no bag at all").status_code == 200
    problem = enrolled(taking, "torn", "no.mcap")["problem"]
    assert problem["type"].endswith("invalid-recording") and problem["detail"].startswith("no.mcap "), problem
    data = write_mcap(tmp_path / "cut.mcap", walk(12), chunk_size=20_000).read_bytes()
    assert put(taking, "torn", "cut.mcap", 0, data[: len(data) // 2]).status_code == 200
    result = enrolled(taking, "torn", "cut.mcap", keep_standing=True)["result"]
    assert 0 < result["frames"] < 12 and result["changes"] == {"created": result["frames"]}
    assert "cut short" in result["remarks"][0] and str(taking.data_dir) not in result["remarks"][0]
    with Client(str(taking.client.base_url)) as client:
        recordings = client.maps["torn"].recordings
        assert recordings.size("no.mcap") == 13
        recordings.delete("no.mcap")
        with pytest.raises(UnknownRecording):
            recordings.delete("no.mcap")


def test_what_is_refused(taking: Server) -> None:
    taking.create_map("refusing")
    for name, offset, data, kind, expected in (
        ("walk.mp4", 0, b"x", "application/octet-stream", "invalid-request"),
        (".mcap", 0, b"x", "application/octet-stream", "invalid-request"),
        ("walk.mcap", -1, b"x", "application/octet-stream", "invalid-request"),
        ("walk.mcap", 7, b"x", "application/octet-stream", "recording-offset"),
        ("walk.mcap", 0, b"x", "text/plain", "unsupported-media-type"),
        ("walk.mcap", 0, bytes(3 << 20), "application/octet-stream", "staging-full"),
    ):
        assert slug(put(taking, "refusing", name, offset, data, kind)) == expected, (name, offset)
    with Client(str(taking.client.base_url)) as client:
        recordings = client.maps["refusing"].recordings
        recordings.delete("walk.mcap")
        with pytest.raises(RecordingOffset):
            client.connection.request("PUT", recordings._of("walk.mcap"), params={"offset": 1}, content=b"x",
                                      media_type="application/octet-stream")  # fmt: skip
    order = taking.client.post("/v1/maps/refusing/recordings/walk.mcap", json={})
    assert (order.status_code, slug(order)) == (404, "unknown-recording")
    put(taking, "refusing", "walk.mcap", 0, b"x")
    for body in (
        {"every_metres": 0},
        {"every_degrees": 181},
        {"fixed_frame": "map"},
        {"sequence": "a/b"},
        {"file": "/etc/passwd"},
    ):
        assert taking.client.post("/v1/maps/refusing/recordings/walk.mcap", json=body).status_code == 422, body
    strange = taking.client.post("/v1/maps/refusing/recordings/walk.mcap", json={"camera": "none"})
    assert slug(strange) == "unknown-camera"


def test_the_audit_trail_has_who_sent_and_removed_a_bag(taking: Server, tmp_path: Path) -> None:
    data = write_mcap(tmp_path / "walk.mcap", walk()).read_bytes()
    taking.create_map("audited")
    for at in range(0, len(data), 10_000):
        assert put(taking, "audited", "walk.mcap", at, data[at : at + 10_000]).status_code == 200
    assert put(taking, "audited", "walk.mcap", 7, b"x").status_code == 409
    job = enrolled(taking, "audited", "walk.mcap", keep_standing=True)
    assert put(taking, "audited", "other.mcap", 0, data).status_code == 200
    assert taking.client.delete("/v1/maps/audited/recordings/other.mcap").status_code == 204

    def told() -> list[dict[str, Any]]:
        page = taking.client.get("/v1/audit", params={"map": "audited", "limit": 100}).json()["items"]
        return [one for one in page if one.get("recording") is not None]

    wait_until(lambda: len(told()) == 7)  # the line of a request is written after its answer
    lines = {(one["operation"], one["event"], one["recording"], one.get("status")): one for one in told()}
    enrolment = ("enrol_recording", "change", "walk.mcap", 202)
    assert lines.keys() == {
        ("upload_recording", "change", "walk.mcap", 200),  # the first piece; those that go on have no lines
        ("upload_recording", "change", "walk.mcap", 409),
        enrolment,
        ("enrol_recording", "job running", "walk.mcap", None),
        ("enrol_recording", "job succeeded", "walk.mcap", None),
        ("upload_recording", "change", "other.mcap", 200),
        ("delete_recording", "change", "other.mcap", 204),
    }
    assert (lines[enrolment]["bytes"], lines[enrolment]["job"]) == (len(data), job["id"])


def test_the_command_that_erases_says_which_bags_wait(taking: Server, placerec: Placerec) -> None:
    taking.create_map("wiped")
    assert put(taking, "wiped", "walk.mcap", 0, b"of some day").status_code == 200
    words = ("maps", "erase", "wiped", "--sequence", "monday", "--yes", "--url", str(taking.client.base_url))
    assert "walk.mcap" in placerec(*words).stderr
    assert "Bags removed: 1." in placerec(*words, "--bags").stderr
    told = placerec(*words).stderr
    assert "walk.mcap" not in told and "is a name mistyped?" in told
    assert "mistyped" not in placerec("maps", "erase", "wiped", "--url", str(taking.client.base_url)).stderr


def test_a_later_map_of_a_name_has_no_bags_of_the_deleted_one(taking: Server) -> None:
    taking.create_map("deleted")
    assert put(taking, "deleted", "walk.mcap", 0, b"of the first map").status_code == 200
    assert taking.client.delete("/v1/maps/deleted").status_code == 204
    taking.create_map("deleted")
    assert taking.client.get("/v1/maps/deleted/recordings/walk.mcap").json()["bytes"] == 0


def test_a_map_that_is_deleted_under_an_upload_ends_it(taking: Server) -> None:
    taking.create_map("under")

    def body() -> Iterator[bytes]:
        yield bytes(1 << 20)
        while not taking.client.get("/v1/maps/under/recordings/walk.mcap").json()["bytes"]:
            pass
        assert taking.client.delete("/v1/maps/under").status_code == 204
        yield bytes(1 << 20)

    with httpx.Client(base_url=taking.client.base_url) as uploading:
        answer = uploading.put(
            "/v1/maps/under/recordings/walk.mcap", content=body(), headers={"Content-Type": OCTETS}, timeout=60
        )
    assert (answer.status_code, slug(answer)) == (404, "unknown-recording")
    taking.create_map("under")
    assert taking.client.get("/v1/maps/under/recordings/walk.mcap").json()["bytes"] == 0


def test_no_job_takes_a_bag_while_a_piece_of_it_arrives(taking: Server) -> None:
    taking.create_map("arriving")
    refused: list[str] = []

    def body() -> Iterator[bytes]:
        yield bytes(1 << 20)
        while not taking.client.get("/v1/maps/arriving/recordings/walk.mcap").json()["bytes"]:
            pass
        refused.append(slug(taking.client.post("/v1/maps/arriving/recordings/walk.mcap", json={})))
        yield b"the end"

    with httpx.Client(base_url=taking.client.base_url) as uploading:
        answer = uploading.put(
            "/v1/maps/arriving/recordings/walk.mcap", content=body(), headers={"Content-Type": OCTETS}, timeout=60
        )
    assert answer.status_code == 200 and refused == ["recording-in-use"]
    assert taking.client.delete("/v1/maps/arriving/recordings/walk.mcap").status_code == 204


def test_bags_of_one_key_take_no_room_from_another(tmp_path: Path) -> None:
    store = Keys.of(tmp_path / "service" / "data")
    secrets = {name: store.create(name, "enrol")[1] for name in ("robot", "greedy")}
    secrets["boss"] = store.create("boss", "admin")[1]
    server = Server(tmp_path / "service", {"max_recording_bytes": 1 << 20}).wait()

    def sent(name: str, bag: str, count: int) -> tuple[int, str]:
        answer = server.client.put(
            f"/v1/maps/lab/recordings/{bag}.mcap",
            content=bytes(count),
            headers={"Content-Type": OCTETS, "Authorization": f"Bearer {secrets[name]}"},
        )
        return answer.status_code, "" if answer.status_code == 200 else slug(answer)

    boss = {"Authorization": f"Bearer {secrets['boss']}"}
    assert server.client.post("/v1/maps", json={"id": "lab"}, headers=boss).status_code == 201
    assert sent("greedy", "first", 1 << 20) == (200, "")
    assert sent("greedy", "second", 1) == (503, "staging-full")
    assert sent("robot", "walk", 1 << 19) == (200, "")
    assert sent("robot", "more", 1) == (503, "staging-full")
    assert server.stop() == 0


@pytest.mark.thorough
def test_a_service_that_is_killed_while_it_enrols_a_bag_goes_on(tmp_path: Path) -> None:
    server = Server(tmp_path / "service").wait()
    server.create_map("lab")
    said = [compressed(START + number * SECOND, jpeg(number)) for number in range(150)]
    data = write_mcap(tmp_path / "long.mcap", said).read_bytes()
    assert put(server, "lab", "long.mcap", 0, data).status_code == 200
    job = server.client.post("/v1/maps/lab/recordings/long.mcap", json={"keep_standing": True}).json()
    in_use = put(server, "lab", "long.mcap", len(data), b"x")
    assert in_use.status_code == 200 or slug(in_use) == "recording-in-use"
    job = reaching(server, job, 64)
    server.kill()
    again = Server(tmp_path / "service").wait()
    ended = finished(again, job)
    assert ended["state"] == "succeeded" and ended["result"]["places"] == 150, ended
    assert sum(ended["result"]["changes"].values()) == 150
    assert not list((tmp_path / "service" / "data" / "recordings").glob("*/*"))
    assert again.stop() == 0
