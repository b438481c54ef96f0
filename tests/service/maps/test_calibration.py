"""Calibrating maps over HTTP by labelled frames, by a second traverse and by their own frames; refused requests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest

from core.errors import RevisionMismatch
from core.judgement.trials import Trials, gathered
from core.judgement.verdict import Calibration
from core.store import Map
from service.maps import calibration
from service.maps.schemas import CalibrationOrder, CalibrationReport
from tests.service.engines import ENCODER, end_of, runtime_at
from tests.service.map_jobs import finished
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem

PLACES = 16
PROMISE = {"rule": "precision", "value": 0.85}
"""Sixteen right answers are too few for a higher precision."""
APART = 20.0  # metres: over three times the radius of a place, so that places are no neighbours


@pytest.fixture(scope="module")
def walked(server: Server) -> str:
    """A map of two traverses past the same sixteen places, and six that only the second one passed."""
    server.create_map("walked")
    for number in range(PLACES):
        pose = {"x": APART * number, "y": 0}
        server.enrol("walked", f"m{number}", jpeg(number), **pose, sequence="monday")
        server.enrol("walked", f"t{number}", encoded(seen_again(scene(number), number)), **pose, sequence="tuesday")
    for number in range(PLACES, PLACES + 6):
        server.enrol("walked", f"t{number}", jpeg(number), x=APART * number, y=0, sequence="tuesday")
    return "walked"


def order(**fields: object) -> dict[str, Any]:
    return {"method": "sequence", "sequence": "tuesday", "dry_run": True, "target": PROMISE, **fields}


def calibrate(client: httpx.Client, map_id: str, **fields: object) -> httpx.Response:
    return client.post(f"/v1/maps/{map_id}/calibrate", json=order(**fields))


def labelled(
    client: httpx.Client, map_id: str, labels: object, files: dict[str, bytes], **fields: object
) -> httpx.Response:
    said = json.dumps({"method": "frames", "dry_run": True, "labels": labels, **fields})
    parts: list[tuple[str, Any]] = [("calibration", (None, said, "application/json"))]
    parts += [(name, (name, data, "image/jpeg")) for name, data in files.items()]
    return client.post(f"/v1/maps/{map_id}/calibrate", files=parts)


@pytest.mark.thorough
def test_a_second_traverse_calibrates_and_its_threshold_judges(server: Server, walked: str) -> None:
    before = server.client.get(f"/v1/maps/{walked}")
    dry = calibrate(server.client, walked).json()
    assert "stored" in dry, dry
    assert dry["stored"] is False
    assert server.client.get(f"/v1/maps/{walked}").json() == before.json()

    report = calibrate(server.client, walked, dry_run=False).json()
    assert report["stored"] is True and report["calibration"] == dry["calibration"]
    assert report["previous"] == before.json()["calibration"]
    after = server.client.get(f"/v1/maps/{walked}").json()
    assert after["calibration"] == report["calibration"]
    assert after["calibration"]["source"] == "sequence:tuesday"
    assert (after["calibration"]["frames"], after["revision"]) == (PLACES + 6, before.json()["revision"] + 1)

    measured = report["measurement"]
    assert (measured["known"], measured["unknown"]) == (PLACES, PLACES + 6)
    assert measured["auc_roc"] > 0.8 and measured["auc_roc_right"] > 0.8
    held = measured["cross_validated"]
    for share in (held["precision"], held["recall"], held["false_accept_rate"]):
        assert 0 <= share["low"] <= share["value"] <= share["high"] <= 1
    assert held["reliability"]["answers"] == 2 * PLACES + 6
    thresholds = [point["threshold"] for point in measured["points"]]
    assert thresholds == sorted(thresholds)
    assert "22 frames" in report["warnings"][0]
    answer = server.query(walked, jpeg(3))
    assert answer["threshold"] == report["calibration"]["threshold"]

    reset = server.client.patch(f"/v1/maps/{walked}", json={"calibration": None})
    assert reset.json()["calibration"]["source"] == "encoder-default"


@pytest.mark.thorough
def test_stated_pairs_stand_in_for_poses(server: Server, walked: str) -> None:
    pairs = {f"t{number}": f"m{number}" for number in range(PLACES)} | {f"t{PLACES}": None}
    report = calibrate(server.client, walked, pairs=pairs).json()["measurement"]
    assert (report["frames"], report["known"], report["unknown"]) == (PLACES + 1, PLACES, PLACES + 1)
    assert report["right"] >= 0.8 * PLACES
    too_much = calibrate(server.client, walked, pairs=pairs, target={"rule": "precision", "value": 0.99})
    assert "promise" in assert_problem(too_much, 422, "calibration-impossible")["detail"]
    turned = {f"t{number}": f"m{(number + 8) % PLACES}" for number in range(PLACES)}
    problem = assert_problem(calibrate(server.client, walked, pairs=turned), 422, "calibration-impossible")
    assert "right" in problem["detail"]


@pytest.mark.thorough
def test_labelled_frames(server: Server, walked: str) -> None:
    files = {f"f{number}": encoded(seen_again(scene(number), 100 + number)) for number in range(14)}
    files |= {f"stranger{number}": jpeg(200 + number) for number in range(4)}
    labels = [{"file": name, "place": f"m{name[1:]}" if name[0] == "f" else None} for name in files]
    response = labelled(server.client, walked, labels, files, target={"rule": "false_accept_rate", "value": 0.1})
    assert response.status_code == 200, response.text
    report = response.json()
    assert report["measurement"]["known"] == 14 and report["measurement"]["unknown"] == 18
    assert report["calibration"]["source"] == "frames"
    strict = labelled(server.client, walked, labels, files, target={"rule": "false_accept_rate", "value": 0.01}).json()
    assert strict["calibration"]["threshold"] >= report["calibration"]["threshold"]
    assert strict["measurement"]["cross_validated"]["false_accept_rate"]["value"] <= 0.1
    # The order of the labels is that of the form or not; the answer is the same.
    again = labelled(server.client, walked, labels[::-1], files, target={"rule": "false_accept_rate", "value": 0.1})
    assert again.json()["calibration"]["threshold"] == pytest.approx(report["calibration"]["threshold"], abs=1e-6)


def test_labelled_frames_of_a_camera(server: Server, walked: str) -> None:
    # All that the frame shows is behind the mask, so that it is blank where the mask is applied.
    mask = {"polygons": [[[0, 0.4], [1, 0.4], [1, 1], [0, 1]]]}
    server.client.put(f"/v1/maps/{walked}/cameras/lidded", json={"mask": mask}).raise_for_status()
    pixels = blank(320, 240)
    pixels[144:] = scene(0)[144:]
    files = {"f": encoded(pixels)}
    lidded = labelled(server.client, walked, [{"file": "f", "place": "m0", "camera": "lidded"}], files)
    assert_problem(lidded, 422, "no-regions")
    absent = labelled(server.client, walked, [{"file": "f", "place": "m0", "camera": "absent"}], files)
    assert_problem(absent, 404, "unknown-camera")
    plain = labelled(server.client, walked, [{"file": "f", "place": "m0"}], files)
    assert_problem(plain, 422, "calibration-impossible")


@pytest.mark.thorough
def test_the_own_frames_of_a_map_calibrate_it_with_a_warning(server: Server, map_id: str) -> None:
    for number in range(12):
        for step in range(2):
            data = encoded(seen_again(scene(number), step)) if step else jpeg(number)
            server.enrol(map_id, f"p{number}-{step}", data, x=APART * number + step, y=0)
    report = calibrate(server.client, map_id, method="map", sequence=None, target={"rule": "mean_of_negatives"}).json()
    assert report["calibration"]["source"] == "map"
    assert "one walk" in report["warnings"][0]
    assert report["measurement"]["frames"] == 24


@pytest.mark.thorough
def test_a_job_does_it_in_the_background(server: Server, walked: str) -> None:
    asked = calibrate(server.client, walked, background=True)
    assert asked.status_code == 202, asked.text
    assert asked.headers["location"] == f"/v1/jobs/{asked.json()['id']}"
    job = finished(server, asked.json())
    assert job["state"] == "succeeded", job
    assert job["result"] == calibrate(server.client, walked).json()


def test_a_map_too_weak_says_so_and_keeps_its_calibration(server: Server, map_id: str) -> None:
    for number in range(4):
        server.enrol(map_id, f"p{number}", jpeg(number), x=APART * number, y=0, sequence="tuesday")
    before = server.client.get(f"/v1/maps/{map_id}").json()
    for fields in ({"method": "map", "sequence": None}, {}):
        problem = assert_problem(
            calibrate(server.client, map_id, dry_run=False, **fields), 422, "calibration-impossible"
        )
        assert "at least 10" in problem["detail"]
    assert server.client.get(f"/v1/maps/{map_id}").json() == before


def test_a_traverse_without_poses_or_pairs(server: Server, map_id: str) -> None:
    server.enrol(map_id, "p", jpeg(1), sequence="tuesday")
    problem = assert_problem(calibrate(server.client, map_id), 422, "calibration-impossible")
    assert "pairs" in problem["detail"]


@pytest.mark.parametrize(
    "fields",
    [
        {"method": "guess"},
        {"sequence": None},
        {"method": "map"},
        {"method": "map", "sequence": None, "pairs": {"a": "b"}},
        {"method": "frames", "sequence": None},
        {"target": {"rule": "precision"}},
        {"target": {"rule": "precision", "value": 1.5}},
        {"target": {"rule": "mean_of_negatives", "value": 0.1}},
        {"most": 3},
        {"labels": []},
        {"pairs": {}},
        {"unknown": 1},
    ],
)
def test_orders_that_do_not_fit(client: httpx.Client, walked: str, fields: dict[str, Any]) -> None:
    assert_problem(calibrate(client, walked, **fields), 422, "invalid-request")


def test_unknown_names(client: httpx.Client, walked: str) -> None:
    assert_problem(calibrate(client, "nowhere"), 404, "unknown-map")
    assert_problem(calibrate(client, walked, sequence="sunday"), 404, "unknown-sequence")
    assert_problem(calibrate(client, walked, pairs={"t1": "m99"}), 404, "unknown-place")
    assert_problem(calibrate(client, walked, pairs={"m1": "m2"}), 404, "unknown-place")
    files = {"f": jpeg(1)}
    assert_problem(labelled(client, walked, [{"file": "f", "place": "x"}], files), 404, "unknown-place")


def test_forms_that_do_not_fit(client: httpx.Client, walked: str) -> None:
    label = {"file": "f", "place": "m1"}
    assert_problem(labelled(client, walked, [label], {}), 422, "invalid-request")
    assert_problem(labelled(client, walked, [label, label], {"f": jpeg(1)}), 422, "invalid-request")
    assert_problem(labelled(client, walked, [{"file": "g", "place": "m1"}], {"f": jpeg(1)}), 422, "invalid-request")
    assert_problem(labelled(client, walked, [label], {"f": b"nothing"}), 422, "not-an-image")
    assert_problem(labelled(client, walked, [label], {"f": encoded(blank())}), 422, "no-regions")
    assert_problem(labelled(client, walked, [label], {"f": jpeg(1)}, background=True), 422, "invalid-request")
    no_order = client.post(f"/v1/maps/{walked}/calibrate", files={"f": ("f", jpeg(1), "image/jpeg")})
    assert_problem(no_order, 422, "invalid-request")


def test_bodies_that_are_no_orders(client: httpx.Client, walked: str) -> None:
    path = f"/v1/maps/{walked}/calibrate"
    json_type = {"Content-Type": "application/json"}
    assert_problem(client.post(path, content=b"{", headers=json_type), 400, "malformed-body")
    assert_problem(client.post(path, content=b"[]", headers=json_type), 422, "invalid-request")
    assert_problem(
        client.post(path, content=jpeg(1), headers={"Content-Type": "image/jpeg"}), 415, "unsupported-media-type"
    )


def test_an_edit_in_between_is_noticed(client: httpx.Client, walked: str) -> None:
    response = client.post(f"/v1/maps/{walked}/calibrate", json=order(dry_run=False), headers={"If-Match": '"999"'})
    assert_problem(response, 412, "revision-mismatch")


@pytest.mark.thorough
def test_what_an_operator_sets_meanwhile_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A job that finds another calibration, and one that finds other edits; without HTTP."""
    with runtime_at(tmp_path) as runtime:
        lab = runtime.engine.maps.create("lab", ENCODER, 8)
        manual = Calibration(source="manual", threshold=0.5, margin=0.1, background_mean=0.3, background_deviation=0.1)
        found = manual.model_copy(update={"source": "map", "threshold": 0.25})

        def measure(map_: Map, *_: object) -> tuple[CalibrationReport, Trials]:
            if happens is not None:
                map_.edit({"calibration": happens})
            report = CalibrationReport.model_construct(
                map="lab", encoder=ENCODER, method="map", stored=True, calibration=found, previous=manual, warnings=[]
            )
            return report, gathered([])

        monkeypatch.setattr(calibration, "measure", measure)
        monkeypatch.setattr(runtime.engine, "load_encoder", lambda _: None)
        wanted = calibration.job_arguments(lab, CalibrationOrder(method="map"), None)
        happens: Calibration | None = manual
        job = end_of(runtime, runtime.jobs.submit(calibration.KIND, "lab", arguments=wanted))
        assert job.problem is not None and job.problem["type"] == "urn:placerec:problem:revision-mismatch"
        assert lab.record.calibration == manual

        happens = None
        lab.edit({"description": "any other change does not matter"})
        wanted = calibration.job_arguments(lab, CalibrationOrder(method="map"), None)
        lab.edit({"description": "nor one that comes later"})
        assert end_of(runtime, runtime.jobs.submit(calibration.KIND, "lab", arguments=wanted)).state == "succeeded"
        assert lab.record.calibration == found

        with pytest.raises(RevisionMismatch):
            calibration.store(lab, manual, manual, None)
        with pytest.raises(RevisionMismatch):
            calibration.store(lab, manual, found, lab.record.revision - 1)
        calibration.store(lab, manual, found, lab.record.revision)
        assert lab.record.calibration == manual


def test_a_request_that_runs_out_of_time_stores_nothing(server: Server, walked: str) -> None:
    before = server.client.get(f"/v1/maps/{walked}").json()["calibration"]
    response = server.client.post(
        f"/v1/maps/{walked}/calibrate",
        json=order(dry_run=False, target={"rule": "precision", "value": 0.5}),
        headers={"X-Request-Timeout": "0.001"},
    )
    assert_problem(response, 503, "deadline-exceeded")
    assert server.client.get(f"/v1/maps/{walked}").json()["calibration"] == before
