"""Poses of a form that no vehicle drives: refused by place, or remarked."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from benchmarks.geometry.pose import CAMERA
from core.recordings.plausibility import MOST_SPEED
from service.places.plausible import judge_entries
from tests.core.recognition.test_pose_survey import walk
from tests.service.encoders import COARSE
from tests.service.map_jobs import finished
from tests.service.places.test_bulk_enrolment import form, frames, sent
from tests.service.scenes import encoded
from tests.service.server import Server

NOON = datetime(2026, 11, 20, 12, tzinfo=UTC)


def drive(count: int = 20, geographic: bool = False, **more: Any) -> list[dict[str, Any]]:
    """Places of a traverse, two metres and a second apart."""
    entries: list[dict[str, Any]] = []
    for number in range(count):
        at = {"latitude": 48 + number * 2e-5, "longitude": 2.0} if geographic else {"x": 2.0 * number, "y": 0.0}
        taken = (NOON + timedelta(seconds=number)).isoformat()
        entries.append({"id": f"p{number}", "file": "f", "sequence": "monday", "timestamp": taken, **at, **more})
    return entries


def changed(at: dict[int, dict[str, Any]], **more: Any) -> list[dict[str, Any]]:
    entries = drive(**more)
    for position, fields in at.items():
        entries[position] |= fields
    return entries


def untimed(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{name: value for name, value in entry.items() if name != "timestamp"} for entry in entries]


@pytest.mark.parametrize(
    ("entries", "refused", "told", "said"),
    [
        (drive(), [], (), ()),
        (drive()[::-1], [], (), ()),
        (changed({7: {"x": 1e6}}), [7], ("999988.0 m from that of p6, 1 s away", "60 m/s"), ("p7", "999 988 m within")),
        (changed({7: {"x": 1e6}})[::-1], [12], ("m from that of p",), ("the traverse monday leaps once",)),
        (changed({3: {"latitude": 0.0, "longitude": 0.0}}, geographic=True), [3], ("without a fix",), ("no fix",)),
        (changed({9: {"latitude": 48.5}}, geographic=True), [9], ("55",), ("leaps once",)),
        (
            changed({at: {"x": 2.0 * at + 900} for at in range(1, 20, 2)}),
            list(range(20)),
            ("m from that of p",),
            ("alternates between two publishers",),
        ),
        (changed({at: {"x": 2.0 * at + 900} for at in range(10, 20)}), [], (), ("goes on from there",)),
        (untimed(changed({7: {"x": 5e6}})), [], (), ("p7", "no times tell")),
        ([*changed({7: {"x": 1e6}}), "no entry", {"id": "half", "file": "f", "x": 1.0}], [7], ("1 s away",), ("p7",)),
    ],
)
def test_places_that_no_vehicle_can_reach_are_refused_by_name(
    entries: list[Any], refused: list[int], told: tuple[str, ...], said: tuple[str, ...]
) -> None:
    found, remarks = judge_entries(entries, MOST_SPEED)
    assert sorted(found) == refused
    for words in told:
        assert all(words in str(found[position]) for position in refused[:1]), found
    assert len(remarks) == (1 if said else 0)
    for words in said:
        assert words in remarks[0]


def test_the_limit_of_speed_is_the_callers() -> None:
    entries = [{**entry, "x": 100 * entry["x"]} for entry in drive()]
    assert judge_entries(entries, MOST_SPEED)[1] and judge_entries(entries, 300) == ({}, [])


def test_a_job_refuses_what_cannot_be_and_enrols_the_rest(server: Server) -> None:
    server.create_map("plausible", encoder=COARSE)
    pictures = {f"p{number}": data for number, data in enumerate(frames(6))}
    entries = [{**entry, "file": entry["id"]} for entry in changed({2: {"x": 1e6}}, count=6)]
    result = finished(server, sent(server, "plausible", **form(pictures, entries)).json())["result"]
    assert result["changes"] == {"created": 5} and "the traverse monday leaps once" in result["remarks"][0]
    (item,) = result["failed"]["items"]
    assert (item["id"], item["status"]) == ("p2", 422) and item["problem"]["type"].endswith(":implausible-pose")
    alone = server.client.post("/v1/maps/plausible/places?most_speed=90", **form(pictures, entries))
    assert alone.status_code == 422 and "most_speed needs background" in alone.text


def test_headings_that_are_turned_are_remarked_by_the_job_and_by_the_health_report(server: Server) -> None:
    """A camera that looks ahead, with headings 90° to the left of that: camera axes."""
    server.create_map("turned", encoder=COARSE)
    lens = {"intrinsics": CAMERA.model_dump(mode="json")}
    assert server.client.put("/v1/maps/turned/cameras/front", json=lens).status_code in (200, 201)
    pictures, poses = walk(0.0)
    entries = [
        {
            "id": f"p{n}",
            "file": f"p{n}",
            "x": x,
            "y": y,
            "heading": (heading + 90) % 360,
            "sequence": "a",
            "camera": "front",
        }
        for n, (x, y, heading) in enumerate(poses.tolist())
    ]
    sending = form({f"p{n}": encoded(one) for n, one in enumerate(pictures)}, entries)
    (remark,) = finished(server, sent(server, "turned", **sending).json())["result"]["remarks"]
    assert "The headings of the traverse 'a' are turned by" in remark and "Camera axes?" in remark
    (found,) = server.client.get("/v1/maps/turned/health").json()["poses"]
    assert found["sequence"] == "a" and found["remark"] == remark and found["turned"] == pytest.approx(-90, abs=8)


def test_a_map_states_how_exact_its_poses_are(server: Server) -> None:
    server.create_map("stated", encoder=COARSE, pose_accuracy={"metres": 0.5, "degrees": 2})
    found = server.client.get("/v1/maps/stated")
    assert found.json()["pose_accuracy"] == {"metres": 0.5, "degrees": 2}
    headers = {"If-Match": found.headers["ETag"]}
    edited = server.client.patch("/v1/maps/stated", json={"pose_accuracy": {"metres": 2}}, headers=headers)
    assert edited.status_code == 200 and edited.json()["pose_accuracy"]["metres"] == 2
    wrong = {"pose_accuracy": {"metres": -1}}
    assert server.client.patch("/v1/maps/stated", json=wrong, headers={"If-Match": "*"}).status_code == 422
    server.enrol("stated", "p0", frames(1)[0], x=0, y=0)
    pose = server.query("stated", frames(1)[0])["pose"]
    assert pose is None or pose["covariance"][0] >= 2**2
