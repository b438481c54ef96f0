"""A map that calibrates itself: by runs, which know places that their frames were not sure of, and by its own traverses
as soon as they are aligned."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from service.access.keys import Keys
from tests.service.commands.conftest import Placerec, placerec
from tests.service.learning.test_lessons import CORRIDOR, SAME, drive, frames_of, lessons, taught, until_known
from tests.service.map_jobs import finished
from tests.service.server import Server, assert_problem

__all__ = ["placerec"]

pytestmark = [
    pytest.mark.thorough,
    pytest.mark.skipif(not CORRIDOR.is_dir(), reason="needs the data set eval/corridor"),
]


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, list[str]]]:
    """A server, and two keys that teach."""
    server = Server(tmp_path_factory.mktemp("weighing"), {}).wait()
    keys = Keys.of(server.data_dir)
    made = [keys.create(name, "enrol", learn=True)[1] for name in ("robot-1", "robot-2")]
    _, operator = keys.create("operator", "admin")  # the last one: who knows it knows all
    server.client.headers["Authorization"] = f"Bearer {operator}"
    until_known(server, "operator")
    yield server, made
    assert server.stop() == 0


def calibration(server: Server, map_id: str) -> dict[str, Any]:
    found: dict[str, Any] = server.client.get(f"/v1/maps/{map_id}/calibration").json()
    return found


def test_a_run_proposes_and_a_person_stores(keyed: tuple[Server, list[str]]) -> None:
    server, (robot, _) = keyed
    taught(server, "weighed", "propose")
    nothing = server.client.post("/v1/maps/weighed/calibrate", json={"method": "runs"})
    assert "No run" in assert_problem(nothing, 422, "calibration-impossible")["detail"]
    shares = {"method": "runs", "target": {"rule": "false_accept_rate", "value": 0.05}}
    refused = server.client.post("/v1/maps/weighed/calibrate", json=shares)
    assert "only be a precision" in assert_problem(refused, 422, "calibration-impossible")["detail"]
    drive(server, "weighed", key=robot)
    told = lessons(server, "weighed")[0]["calibration"]
    assert told["outcome"] == "proposed" and told["runs"] == 1 and told["frames"] >= 30
    before, after = told["error"]
    assert after < before
    found = calibration(server, "weighed")
    strangers = [found[which]["false_accept_rate"] for which in ("now", "proposed")]
    assert strangers[0]["of"] >= 10, "frames were asked without their places, too"
    assert strangers[1]["count"] <= strangers[0]["count"], "and they are recognized no more often"
    report = found["measured"]["report"]
    assert (report["method"], report["stored"]) == ("runs", False) and found["proposed"] is not None
    assert found["calibration"]["source"] == "encoder-default", "nothing is stored"
    assert any("err with it" in warning for warning in report["warnings"])
    path, tag = "/v1/maps/weighed", f'"{found["revision"]}"'
    stored = server.client.patch(
        path, json={"calibration": {"measured_at": found["measured"]["at"]}}, headers={"If-Match": tag}
    )
    assert stored.status_code == 200, stored.text
    assert calibration(server, "weighed")["calibration"] == report["calibration"]
    again = server.client.post(f"{path}/calibrate", json={"method": "runs", "dry_run": True}).json()
    assert again["calibration"]["threshold"] == pytest.approx(report["calibration"]["threshold"])


def test_a_persons_dry_run_is_not_replaced_by_a_proposal(keyed: tuple[Server, list[str]]) -> None:
    server, (robot, _) = keyed
    taught(server, "watched", "propose")
    order = {"method": "map", "dry_run": True, "target": {"rule": "mean_of_negatives"}}
    measured = server.client.post("/v1/maps/watched/calibrate", json=order)
    assert measured.status_code == 200, measured.text
    drive(server, "watched", key=robot)
    assert lessons(server, "watched")[0]["calibration"]["outcome"] == "proposed"
    assert calibration(server, "watched")["measured"]["report"]["method"] == "map"


def test_by_itself_it_needs_two_robots_and_yields_to_a_person(keyed: tuple[Server, list[str]]) -> None:
    server, robots = keyed
    taught(server, "alone", "propose")
    path = "/v1/maps/alone"
    server.client.patch(path, json={"learning": {"mode": "propose", "calibration": "auto"}}).raise_for_status()
    for robot in (robots[0], robots[0]):
        drive(server, "alone", key=robot)
    assert [one["calibration"]["outcome"] for one in lessons(server, "alone")] == ["proposed"] * 2
    drive(server, "alone", key=robots[1])
    told = lessons(server, "alone")[0]["calibration"]
    assert told["outcome"] == "stored" and told["runs"] == 3
    assert calibration(server, "alone")["calibration"]["source"] == "runs"
    own = {"threshold": 0.1, "margin": 0.003}
    server.client.patch(path, json={"calibration": own}).raise_for_status()
    drive(server, "alone", key=robots[0])
    assert lessons(server, "alone")[0]["calibration"]["outcome"] in ("proposed", "holds")
    assert calibration(server, "alone")["calibration"]["threshold"] == 0.1
    server.client.patch(path, json={"learning": {"mode": "propose", "calibration": "off"}}).raise_for_status()
    drive(server, "alone", key=robots[0])
    assert "calibration" not in lessons(server, "alone")[0]


def aligned(server: Server, map_id: str, **options: Any) -> dict[str, Any]:
    """The result of a job that aligns the later traverse of a map."""
    order = server.client.post(f"/v1/maps/{map_id}/align", json={"sequence": "later", **options})
    assert order.status_code == 202, order.text
    result: dict[str, Any] = finished(server, order.json())["result"]
    return result


def set_learning(server: Server, map_id: str, calibration: str) -> None:
    changed = server.client.patch(f"/v1/maps/{map_id}", json={"learning": {"calibration": calibration}})
    assert changed.status_code == 200, changed.text


@pytest.fixture(scope="module")
def walked_twice(keyed: tuple[Server, list[str]]) -> Server:
    """A server with the map ``twice``, of a traverse with poses and one without."""
    server, _ = keyed
    server.create_map("twice", same_place_radius=SAME)
    for number, (day, later) in enumerate(zip(frames_of("ref"), frames_of("query"), strict=True)):
        assert server.enrol("twice", f"d{number}", day, x=number, y=0, sequence="day").status_code == 201
        assert server.enrol("twice", f"l{number}", later, sequence="later").status_code == 201
    return server


def test_an_alignment_proposes_a_calibration(
    walked_twice: Server, placerec: Placerec, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, path = walked_twice, "/v1/maps/twice"
    assert "calibration" not in aligned(server, "twice", dry_run=True), "nothing is aligned yet"
    set_learning(server, "twice", "off")
    assert "calibration" not in aligned(server, "twice")
    assert calibration(server, "twice")["measured"] is None
    set_learning(server, "twice", "propose")
    told = aligned(server, "twice")["calibration"]
    assert (told["outcome"], told["frames"]) == ("proposed", 60)
    before, after = told["error"]
    assert after < before
    monkeypatch.setenv("PLACEREC_URL", str(server.client.base_url))
    monkeypatch.setenv("PLACEREC_KEY", server.client.headers["Authorization"].removeprefix("Bearer "))
    once_more = " ".join(placerec("maps", "align", "twice", "--sequence", "later").stdout.split())
    change = "recall {:.3f} → {:.3f}, precision {:.3f} → {:.3f}"
    assert f"proposed, by 60 frames: {change.format(*told['recall'], *told['precision'])}" in once_more
    found = calibration(server, "twice")
    held = found["measured"]["report"]["measurement"]["cross_validated"]
    for name in ("recall", "precision"):
        assert told[name] == pytest.approx([found["now"][name]["value"], held[name]["value"]], abs=1e-4)
    shown = " ".join(placerec("maps", "show", "twice").stdout.split())
    effects = [found[which][share]["value"] for share in ("recall", "precision") for which in ("now", "proposed")]
    assert f"aligned:later: {change.format(*effects)}" in shown
    report = found["measured"]["report"]
    assert (report["method"], report["stored"]) == ("sequence", False) and found["proposed"] is not None
    assert found["calibration"]["source"] == "encoder-default", "nothing is stored"
    assert any("alignment alone" in warning for warning in report["warnings"])
    order, tag = {"calibration": {"measured_at": found["measured"]["at"]}}, f'"{found["revision"]}"'
    assert server.client.patch(path, json=order, headers={"If-Match": tag}).status_code == 200
    assert calibration(server, "twice")["calibration"]["source"] == "aligned:later"
    assert "proposed calibration" not in placerec("maps", "show", "twice").stdout, "it is in force"
    assert aligned(server, "twice")["calibration"]["outcome"] == "holds", "there is nothing to gain any more"
    assert "calibration" not in aligned(server, "twice", **{"with": []}), "the traverses were parted again"


def test_an_alignment_calibrates_by_itself_where_no_person_has(walked_twice: Server) -> None:
    server, path = walked_twice, "/v1/maps/twice"
    set_learning(server, "twice", "auto")
    server.client.patch(path, json={"calibration": None}).raise_for_status()
    own = {"calibration": {"threshold": 0.1, "margin": 0.003}}
    server.client.patch(path, json=own).raise_for_status()
    assert aligned(server, "twice")["calibration"]["outcome"] == "proposed"
    assert calibration(server, "twice")["calibration"]["threshold"] == 0.1
    server.client.patch(path, json={"calibration": None}).raise_for_status()
    assert aligned(server, "twice")["calibration"]["outcome"] == "stored"
    found = calibration(server, "twice")
    assert found["calibration"]["source"] == "aligned:later" and found["measured"]["report"]["stored"]
