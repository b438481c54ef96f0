"""A map's calibration over HTTP: what was measured, over a restart, and what another threshold would change."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from tests.service.map_jobs import finished
from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem

PLACES = 16
PROMISE = {"rule": "precision", "value": 0.85}
ORDER: dict[str, Any] = {"method": "sequence", "sequence": "tuesday", "target": PROMISE}


def walk(server: Server, map_id: str) -> None:
    """Fill a map with two traverses past the same sixteen places."""
    for number in range(PLACES):
        pose = {"x": 20 * number, "y": 0}
        server.enrol(map_id, f"m{number}", jpeg(number), **pose, sequence="monday")
        server.enrol(map_id, f"t{number}", encoded(seen_again(scene(number), number)), **pose, sequence="tuesday")


@pytest.fixture(scope="module")
def previewed(server: Server) -> str:
    """A map of two traverses, whose answers are not verified: the curves are of two stages."""
    server.create_map("previewed", verification=False)
    walk(server, "previewed")
    return "previewed"


def state_of(server: Server, map_id: str, **parameters: str) -> dict[str, Any]:
    response = server.client.get(f"/v1/maps/{map_id}/calibration", params=parameters)
    assert response.status_code == 200, response.text
    assert response.headers["etag"] == f'"{response.json()["revision"]}"'
    found: dict[str, Any] = response.json()
    return found


@pytest.mark.thorough
def test_a_threshold_is_previewed_and_applied(server: Server, previewed: str) -> None:
    path = f"/v1/maps/{previewed}"
    fresh = state_of(server, previewed, threshold="0.1")
    assert fresh["calibration"]["source"] == "encoder-default"
    assert (fresh["measured"], fresh["now"], fresh["then"]) == (None, None, None)
    report = server.client.post(f"{path}/calibrate", json=ORDER | {"dry_run": True}).json()
    state = state_of(server, previewed)
    assert state["measured"]["report"] == report and state["then"] is None and state["revision"] == fresh["revision"]
    assert state["now"]["threshold"] == state["calibration"]["threshold"]
    trials, right = report["measurement"]["trials"], report["measurement"]["right"]
    assert sum(state["now"]["verdicts"].values()) == trials
    assert state["now"]["reliability"]["answers"] == trials and state["now"]["reliability"]["right"] == right
    points = report["measurement"]["points"]
    for point in (points[0], points[len(points) // 2], points[-1]):
        then = state_of(server, previewed, threshold=repr(point["threshold"]), margin="0")["then"]
        assert then["recall"]["value"] == pytest.approx(point["recall"])
        assert then["precision"]["value"] == pytest.approx(point["precision"])
        assert then["false_accept_rate"]["value"] == pytest.approx(point["false_accept_rate"])
    none = state_of(server, previewed, threshold="1e9")
    assert none["then"]["verdicts"] == {"recognized": 0, "ambiguous": 0, "unknown": trials}
    assert none["then"]["precision"]["value"] is None and none["now"] == state["now"]
    apart = state_of(server, previewed, threshold="-1e9", margin="1e9")["then"]["verdicts"]
    assert apart["recognized"] + apart["ambiguous"] == trials and apart["ambiguous"] > 0

    applied = state_of(server, previewed, threshold="0.2")
    change = {"calibration": {"threshold": 0.2}}
    tag = f'"{applied["revision"]}"'
    assert server.client.patch(path, json=change, headers={"If-Match": tag}).status_code == 200
    after = state_of(server, previewed)
    assert after["now"] == applied["then"] and after["calibration"]["source"] == "manual"
    assert_problem(server.client.patch(path, json=change, headers={"If-Match": tag}), 412, "revision-mismatch")
    server.client.patch(path, json={"calibration": None})


@pytest.mark.thorough
def test_what_a_dry_run_found_is_stored_unless_it_was_measured_again(server: Server, previewed: str) -> None:
    path = f"/v1/maps/{previewed}"
    report = server.client.post(f"{path}/calibrate", json=ORDER | {"dry_run": True}).json()
    first = state_of(server, previewed)
    server.client.post(f"{path}/calibrate", json=ORDER | {"dry_run": True})
    again = state_of(server, previewed)
    assert again["proposed"]["threshold"] == report["calibration"]["threshold"]
    stale = {"calibration": {"measured_at": first["measured"]["at"]}}
    assert_problem(server.client.patch(path, json=stale), 412, "revision-mismatch")
    both = {"calibration": {"measured_at": again["measured"]["at"], "threshold": 0.1}}
    assert_problem(server.client.patch(path, json=both), 422, "invalid-request")
    stored = server.client.patch(path, json={"calibration": {"measured_at": again["measured"]["at"]}})
    assert stored.status_code == 200 and stored.json()["calibration"] == report["calibration"]
    assert state_of(server, previewed)["now"] == again["proposed"]
    server.client.patch(path, json={"calibration": None})


def test_what_does_not_fit_is_refused(server: Server, previewed: str) -> None:
    for parameters in ({"threshold": "nan"}, {"threshold": "x"}, {"margin": "-1"}, {"margin": "inf"}, {"k": "1"}):
        response = server.client.get(f"/v1/maps/{previewed}/calibration", params=parameters)
        assert_problem(response, 422, "invalid-request")
    assert_problem(server.client.get("/v1/maps/absent/calibration"), 404, "unknown-map")


@pytest.mark.thorough
def test_a_job_is_remembered_over_a_restart_and_forgotten_with_its_map(tmp_path: Path) -> None:
    server = Server(tmp_path).wait()
    server.create_map("lab")
    walk(server, "lab")
    job = server.client.post("/v1/maps/lab/calibrate", json=ORDER | {"background": True}).json()
    report = finished(server, job)["result"]
    before = state_of(server, "lab", threshold="0.15")
    assert before["measured"]["report"] == report and before["calibration"] == report["calibration"]
    assert server.stop() == 0
    server = Server(tmp_path).wait()
    try:
        assert state_of(server, "lab", threshold="0.15") == before
        server.client.delete("/v1/maps/lab")
        server.create_map("lab")
        assert state_of(server, "lab")["measured"] is None
        (tmp_path / "data" / "statistics.sqlite").write_bytes(b"damaged")
        assert math.isfinite(state_of(server, "lab")["calibration"]["threshold"])
    finally:
        server.stop()
