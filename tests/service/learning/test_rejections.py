"""Rejected stretches: where they were is remembered, within bounds, and forgotten when somebody says so."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from threading import Thread

import pytest

from core.errors import UnknownStretch
from core.maps import ReviewSetting
from core.maps.records import MOST_POSES, MOST_REJECTED
from core.places import Pose
from core.store import Map
from service.app.runtime import Runtime
from service.errors.faults import TooManyPlaces
from service.jobs.context import creation_time
from service.learning import new_ground
from service.upkeep import erasure
from tests.service.engines import ENCODER, end_of, enrolments, runtime_at
from tests.service.server import Server

FRAMES = 6


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[Runtime]:
    with runtime_at(tmp_path) as runtime:
        yield runtime


@pytest.fixture
def lab(runtime: Runtime) -> Map:
    made = runtime.engine.maps.create("lab", ENCODER, 8)
    made.enrol(enrolments(0, 6, "p", "monday"))
    return made


def propose(lab: Map, name: str, run: str = "s-1", frames: int = FRAMES) -> None:
    """Have a stretch wait whose frames are a metre apart."""
    told = {"id": name, "run": run, "frames": frames}
    for number in range(frames):
        own = {"place": f"{name}-{number:03d}", "pose": {"x": float(number), "y": 3.0}, "taken": None}
        answer = {"best": None, "session": None, "camera": None, "stretch": told | own}
        assert lab.review.keep(f"{name} {number}".encode(), answer, ReviewSetting())


def rejected(lab: Map) -> list[str]:
    return [one.stretch for one in lab.record.learning.rejected_ground]


def test_where_a_stretch_was_is_all_that_is_left_of_it(lab: Map) -> None:
    propose(lab, "first")
    propose(lab, "second", "s-2", MOST_POSES * 2)
    before = datetime.now(UTC)
    assert new_ground.reject(lab, "first") == FRAMES and new_ground.reject(lab, "second") == MOST_POSES * 2
    assert lab.review.page(None, 1).count == 0 and new_ground.stretches(lab) == []
    first, second = lab.record.learning.rejected_ground
    assert (first.stretch, first.run) == ("first", "s-1") and before <= first.at <= datetime.now(UTC)
    assert [pose.x for pose in first.poses] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert len(second.poses) == MOST_POSES and {pose.y for pose in second.poses} == {3.0}
    assert (second.poses[0].x, second.poses[-1].x) == (0.0, 2.0 * MOST_POSES - 1)
    with pytest.raises(UnknownStretch):
        new_ground.reject(lab, "first")


def test_the_latest_rejections_are_remembered(lab: Map) -> None:
    for number in range(MOST_REJECTED + 2):
        propose(lab, f"s{number}")
        new_ground.reject(lab, f"s{number}")
    assert rejected(lab) == [f"s{number}" for number in range(2, MOST_REJECTED + 2)]
    propose(lab, "s2")
    new_ground.reject(lab, "s2")  # as after a crash between the two steps of a rejection
    assert rejected(lab) == [f"s{number}" for number in range(3, MOST_REJECTED + 2)] + ["s2"]


def test_rejections_in_the_same_moment_are_all_remembered(lab: Map) -> None:
    names = [f"s{number}" for number in range(8)]
    for name in names:
        propose(lab, name)
    threads = [Thread(target=new_ground.reject, args=(lab, name)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(rejected(lab)) == names


def test_what_an_erased_run_was_rejected_for_is_forgotten_with_it(runtime: Runtime, lab: Map) -> None:
    for name, run in (("first", "s-1"), ("second", "s-2")):
        propose(lab, name, run)
        new_ground.reject(lab, name)
    order = {"ids": None, "filter": None, "session": "s-1"}
    job = runtime.jobs.submit(erasure.KIND, "lab", arguments=order, maps={"lab": creation_time(lab)})
    assert end_of(runtime, job).state == "succeeded"
    assert rejected(lab) == ["second"]


def test_a_stretch_beyond_most_places_is_not_accepted(lab: Map) -> None:
    propose(lab, "first")
    setting = lab.record.learning.model_dump()
    lab.edit({"learning": setting | {"most_places": FRAMES - 1}})
    with pytest.raises(TooManyPlaces, match=f"may learn {FRAMES - 1} places"):
        new_ground.check_room(lab, new_ground.find(lab, "first"))
    assert not new_ground.has_room(lab, FRAMES) and new_ground.has_room(lab, FRAMES - 1)
    lab.edit({"learning": setting | {"most_places": FRAMES}})
    new_ground.check_room(lab, new_ground.find(lab, "first"))
    assert new_ground.has_room(lab, FRAMES)


@pytest.mark.parametrize(("aside", "covered"), [(0.0, True), (4.0, True), (6.0, False)])
def test_ground_is_the_same_within_a_radius(aside: float, covered: bool) -> None:
    there = [Pose(x=number, y=0.0) for number in range(FRAMES)]
    assert new_ground.covers(there, [Pose(x=number, y=aside) for number in range(FRAMES)], 5.0) is covered
    assert not new_ground.covers([Pose(latitude=0.0, longitude=0.0)], there, 5.0)


def test_a_stretch_that_is_mostly_elsewhere_is_new() -> None:
    there = [Pose(x=number, y=0.0) for number in range(10)]
    assert new_ground.covers(there, [Pose(x=10 * number, y=0.0) for number in range(3)], 5.0)
    assert not new_ground.covers(there, [Pose(x=10 * number, y=0.0) for number in range(5)], 5.0)


def test_the_list_is_read_and_edited_over_http(server: Server, map_id: str) -> None:
    path = f"/v1/maps/{map_id}"
    one = {"stretch": "s-1-00", "run": "s-1", "at": "2026-11-27T10:00:00Z", "poses": [{"x": 1.0, "y": 2.0}]}
    two = one | {"stretch": "s-2-00", "poses": [{"latitude": 48.85, "longitude": 2.35}]}
    edited = server.client.patch(path, json={"learning": {"rejected_ground": [one, two]}})
    assert edited.status_code == 200, edited.text
    assert edited.json()["learning"]["rejected_ground"] == [one, two]
    there = server.client.get(path)
    assert there.json()["learning"]["rejected_ground"] == [one, two]
    again = {"learning": {"rejected_ground": there.json()["learning"]["rejected_ground"][1:], "most_looks": 4}}
    left = server.client.patch(path, json=again, headers={"If-Match": there.headers["ETag"]}).json()["learning"]
    assert (left["rejected_ground"], left["most_looks"], left["mode"]) == ([two], 4, "off")
    names = [one | {"stretch": "s-1\n00"}, one | {"stretch": ""}, one | {"run": "\u202es-1"}, one | {"run": "a/b"}]
    wrongs = [*names, one | {"poses": []}, one | {"poses": [{"x": 1.0}]}]
    for wrong in (*([wrong] for wrong in wrongs), [one] * (MOST_REJECTED + 1), one):
        assert server.client.patch(path, json={"learning": {"rejected_ground": wrong}}).status_code == 422
    gone = server.client.patch(path, json={"learning": {"rejected_ground": None}}).json()["learning"]
    assert gone["rejected_ground"] == [] and gone["most_looks"] == 4
