"""Whether frames are known, changed or new, over HTTP: alone, in runs, in events, and by what is usual at a place."""

from __future__ import annotations

from typing import Any

import pytest

from tests.service.encoders import COARSE
from tests.service.events.listening import listening
from tests.service.map_jobs import enrol_frames
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem


def three(change: dict[str, Any]) -> dict[str, float]:
    """The probabilities, which must belong to the verdict."""
    found = {name: change[name] for name in ("known", "changed", "new")}
    assert sum(found.values()) == pytest.approx(1) and min(found.values()) >= 0
    told = "new" if found["new"] >= 0.5 else max(("known", "changed"), key=lambda name: found[name])
    assert found[change["verdict"]] == found[told]
    return found


def again(number: int) -> bytes:
    return encoded(seen_again(scene(number), 1))


@pytest.fixture(scope="module")
def walked(server: Server) -> str:
    server.create_map("changing")
    for number in range(8):
        assert server.enrol("changing", f"p{number}", jpeg(number), x=6 * number, y=0, sequence="monday").is_success
    return "changing"


def test_a_frame_of_the_map_is_no_new_one_and_a_stranger_is(server: Server, walked: str) -> None:
    seen = [three(server.query(walked, again(number))["change"]) for number in range(4)]
    strange = [three(server.query(walked, jpeg(number))["change"]) for number in range(40, 44)]
    assert max(one["new"] for one in seen) < min(one["new"] for one in strange)
    assert all(one["known"] > one["changed"] and one["new"] < 0.5 for one in seen)
    assert server.query(walked, encoded(blank()))["change"] is None


def test_an_empty_map_and_a_calibration_without_probabilities_say_nothing(server: Server) -> None:
    server.create_map("nothing")
    assert server.query("nothing", jpeg(1))["change"] is None
    server.create_map("coarse-change", encoder=COARSE)
    enrol_frames(server, "coarse-change", [jpeg(1), jpeg(2)])
    answer = server.query("coarse-change", again(1))
    assert (answer["change"] is None) == (answer["probability"] is None)


def test_all_kinds_of_queries_say_the_same(server: Server, walked: str) -> None:
    frame, typed = again(2), {"Content-Type": "image/png" if again(2).startswith(b"\x89PNG") else "image/jpeg"}
    alone = server.query(walked, frame)["change"]
    form = {"one": ("one", frame, typed["Content-Type"])}
    (item,) = server.client.post(f"/v1/maps/{walked}/query:batch", files=form).json()["items"]
    several = server.client.post(f"/v1/query?maps={walked}", content=frame, headers=typed).json()
    closed = server.client.post(f"/v1/maps/{walked}/query:enrol?id=p2", content=jpeg(2), headers=typed)
    assert item["answer"]["change"] == pytest.approx(alone) == several["maps"][0]["change"]
    assert closed.json()["enrolment"] == "unchanged" and three(closed.json()["change"])


def test_a_run_says_it_by_its_belief_and_events_tell_both(server: Server, walked: str) -> None:
    session = server.client.post(f"/v1/maps/{walked}/sessions", json={}).json()["id"]
    frames = f"/v1/maps/{walked}/sessions/{session}/frames"
    with listening(server, walked, parameters={"kinds": "query,session"}) as ear:
        answers = [
            server.client.post(frames, content=content, headers={"Content-Type": "image/jpeg"}).json()
            for content in (jpeg(0), jpeg(1), jpeg(2), encoded(blank()))
        ]
        told = ear.some(8)
    for answer in answers[:3]:
        found = three(answer["change"])
        assert found["new"] == pytest.approx(answer["unknown"]) and three(answer["single"]["change"])
    assert answers[-1]["change"] is answers[-1]["single"]["change"] is None
    singles = [one.data["change"] for one in told if one.name == "query"]
    runs = [one.data["world"] for one in told if one.name == "session"]
    assert singles == [answer["single"]["change"] for answer in answers]
    assert runs == [answer["change"] for answer in answers]
    (latest, *_) = server.client.get(f"/v1/maps/{walked}/answers?limit=4").json()["items"]
    assert latest["change"] is None


@pytest.mark.thorough
def test_frames_that_score_as_ever_become_known_the_more_surely_the_more_there_were(server: Server) -> None:
    server.create_map("usual")
    for number in range(8):
        assert server.enrol("usual", f"p{number}", jpeg(number), x=6 * number, y=0, sequence="monday").is_success
    first = server.query("usual", again(3))
    assert first["verdict"] == "recognized", first
    for _ in range(12):
        server.query("usual", again(3))
    server.client.get("/v1/maps/usual/health?seconds=0.1")  # writes the counts
    later = server.query("usual", again(3))["change"]
    assert later["known"] > first["change"]["known"] and later["new"] == pytest.approx(first["change"]["new"])


def test_alarms_are_a_setting_of_the_map(server: Server, walked: str) -> None:
    none = {"worse_places": None, "changed_places": None, "quiet_stretches": None}
    url = f"/v1/maps/{walked}"
    assert server.client.get(url).json()["alarms"] == none
    edited = server.client.patch(url, json={"alarms": {"changed_places": 3}}).json()
    assert edited["alarms"] == none | {"changed_places": 3}
    edited = server.client.patch(url, json={"alarms": {"worse_places": 10}}).json()
    assert edited["alarms"] == none | {"changed_places": 3, "worse_places": 10}
    edited = server.client.patch(url, json={"alarms": {"changed_places": None}}).json()
    assert edited["alarms"] == none | {"worse_places": 10}
    assert server.client.patch(url, json={"alarms": None}).json()["alarms"] == none
    assert_problem(server.client.patch(url, json={"alarms": {"worse_places": 0}}), 422, "invalid-request")
    trends = server.client.get(f"{url}/health?seconds=0.1").json()["trends"]
    assert trends["alarms"] == [] and trends["worse_count"] == trends["changed_count"] == trends["quiet_count"] == 0
