"""Which calibrations become a map's own, by every way in; what is said of those that should not have; and undoing."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import numpy as np
import pytest
from fastapi.testclient import TestClient

from core.judgement.trials import StagedTrials, Trials
from core.learning import Witness
from core.maps import Enrolment, ReviewSetting
from core.places import PlaceFields
from core.store import Map
from service.access.audit import ASKER
from service.app.application import create_app
from service.learning.run_notes import RunNotes
from service.maps.self_calibration import calibrate_by_run
from service.queries.histories.run_trials import RunTrials
from service.queries.statistics import map_key
from service.settings import Settings
from tests.service.server import assert_problem

HALL = "/v1/maps/hall"
PERSON = {
    "source": "manual",
    "threshold": 0.1,
    "margin": 0.004,
    "background_mean": 0.07,
    "background_deviation": 0.01,
    "curve": {"slope": 60.0, "intercept": -6.0},
    "decision": "leading",
    "frames": 40,
}
"""A calibration by which every answer of :func:`answers` is right with a probability of ½."""


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A service without a server."""
    with TestClient(create_app(Settings(data_dir=tmp_path_factory.mktemp("calibrated")), as_owner=True)) as made:
        yield made


@pytest.fixture
def client(service: TestClient) -> TestClient:
    """The service, with a new map ``hall`` of no places, and with a calibration that a person gave it."""
    service.delete(HALL)
    assert service.post("/v1/maps", json={"id": "hall"}).status_code == 201
    assert patch(service, {"restore": PERSON}).json()["calibration"] == PERSON
    return service


def patch(client: TestClient, calibration: object, tag: str | None = None) -> httpx.Response:
    return client.patch(HALL, json={"calibration": calibration}, headers={} if tag is None else {"If-Match": tag})


def hall(client: TestClient) -> Map:
    found: Map = client.app.state.engine.maps.get("hall")  # type: ignore[attr-defined]
    return found


def answers(strangers: list[int], decision: float = 0.1, count: int = 110) -> StagedTrials:
    """Answers that are right for frames of known places, and wrong for strangers, which have this decision value."""
    known = ~np.isin(np.arange(count), strangers)
    decisions = np.where(known, 0.1, decision)
    return StagedTrials.of(Trials(decisions, np.full(count, np.inf), known, known, np.arange(count)))


CROWDED = answers([*range(5, 110, 11)])
"""Ten strangers among a hundred frames of known places: what is fitted to them believes all."""
ONE_SIDED = answers([])
CLEAR = answers([*range(0, 110, 2)], decision=0.0)


def keep(client: TestClient, trials: StagedTrials, robot: str = "robot 1") -> None:
    """What a run said of the map's answers."""
    source = Witness(robot, datetime.now(UTC) - timedelta(days=2))
    statistics = client.app.state.statistics  # type: ignore[attr-defined]
    statistics.keep_run_trials(map_key(hall(client)), RunTrials("run", source, trials))


def calibrate(client: TestClient, **order: Any) -> httpx.Response:
    return client.post(f"{HALL}/calibrate", json={"method": "runs", **order})


def test_one_that_has_strangers_believed_is_shown_and_not_stored(client: TestClient) -> None:
    keep(client, CROWDED)
    report = calibrate(client, dry_run=True).json()
    told = report["change"]
    assert (told["known"]["answers"], told["strangers"]["answers"]) == (100, 10)
    assert told["strangers"]["before"] == {"probability": pytest.approx(0.5), "error": pytest.approx(0.25)}
    assert told["strangers"]["after"]["error"] > 0.5 and told["known"]["after"]["error"] < 0.1
    assert "strangers would be believed" in told["worse"]

    problem = assert_problem(calibrate(client), 409, "calibration-worse")
    assert "keeps its calibration" in problem["detail"]
    state = client.get(f"{HALL}/calibration").json()
    assert state["measured"]["report"]["stored"] is False and state["measured"]["report"]["change"] == told
    assert_problem(patch(client, {"measured_at": state["measured"]["at"]}), 409, "calibration-worse")
    job = calibrate(client, background=True).json()
    ended = client.get(f"/v1/jobs/{job['id']}?wait=30").json()
    assert ended["state"] == "failed" and ended["problem"]["type"].endswith("calibration-worse"), ended
    assert client.get(HALL).json()["calibration"] == PERSON


@pytest.mark.parametrize(("trials", "outcome"), [(CROWDED, "holds"), (CLEAR, "stored")])
def test_a_map_takes_none_by_itself_that_has_strangers_believed(
    client: TestClient, trials: StagedTrials, outcome: str
) -> None:
    own = PERSON | {"source": "runs"}  # which the map may replace
    learning = {"mode": "propose", "calibration": "auto"}
    client.patch(HALL, json={"learning": learning, "calibration": {"restore": own}}).raise_for_status()
    state = client.app.state  # type: ignore[attr-defined]
    keep(client, trials)
    notes = RunNotes("another", ASKER.get(), Witness("robot 2", datetime.now(UTC)))
    told = calibrate_by_run(state.engine, state.statistics, hall(client), notes, trials)
    assert told["outcome"] == outcome and told["runs"] == 2, told
    assert (client.get(HALL).json()["calibration"] == own) == (outcome == "holds")


def test_labels_of_one_kind_are_said_to_be(client: TestClient) -> None:
    keep(client, ONE_SIDED)
    report = calibrate(client).json()
    assert report["stored"] and report["calibration"]["curve"] == PERSON["curve"]
    assert any("110 frames of places of the map and 0 of strangers" in one for one in report["warnings"])
    doubt = client.get(HALL).json()["calibration_doubt"]
    assert "tell nothing of strangers" in doubt
    assert client.get("/v1/maps").json()["items"][0]["calibration_doubt"] == doubt
    assert client.get(f"{HALL}/health").json()["calibration_doubt"] == doubt
    patch(client, None).raise_for_status()
    assert client.get(HALL).json()["calibration_doubt"] is None
    assert client.get(f"{HALL}/health").json()["calibration_doubt"] is None


def test_one_that_changes_nothing_is_not_stored(client: TestClient) -> None:
    """It would pin the map to these numbers, and name a source that it does not rest on."""
    keep(client, ONE_SIDED)
    first = calibrate(client).json()
    assert first["stored"]
    pinned = first["calibration"] | {"source": "manual", "frames": 7}
    patch(client, {"restore": pinned}).raise_for_status()
    before = client.get(HALL).json()
    again = calibrate(client).json()
    assert not again["stored"] and any("nothing to store" in one for one in again["warnings"])
    assert again["calibration"]["threshold"] == pinned["threshold"]
    after = client.get(HALL).json()
    assert (after["calibration"], after["revision"]) == (pinned, before["revision"])


@pytest.mark.parametrize(("strangers", "doubted"), [(0, True), (2, True), (3, False), (8, True)])
def test_one_that_was_stored_before_is_judged_by_the_labels(client: TestClient, strangers: int, doubted: bool) -> None:
    """No measurement of it is left, as after a restore."""
    map_, setting = hall(client), ReviewSetting()
    vector, local = np.ones(map_.record.dimension, np.float32), np.ones(map_.record.local_shape, np.int8)
    map_.enrol([Enrolment("p", PlaceFields(), vector, 1, bytes(32), local)])
    for number in range(1, 11):
        map_.review.keep(f"file {number}".encode(), {"verdict": "unknown", "camera": None}, setting)
        shown = {"stranger": True} if number <= strangers else {"place": "p"}
        map_.review.label(number, {"label": shown, "at": "2026-11-28T10:00:00+00:00", "by": "ann"})
    patch(client, {"restore": PERSON | {"source": "labels"}}).raise_for_status()
    assert (client.get(HALL).json()["calibration_doubt"] is not None) == doubted


def test_a_change_is_undone_whole(client: TestClient) -> None:
    before = client.get(HALL).json()["calibration"]
    edited = patch(client, {"threshold": 0.2, "margin": 0.01})
    assert edited.json()["calibration"] == before | {"threshold": 0.2, "margin": 0.01}
    measured = before | {"source": "sequence:tuesday", "frames": 300}
    patch(client, {"restore": measured}).raise_for_status()
    stale = patch(client, {"restore": before}, edited.headers["ETag"])
    assert_problem(stale, 412, "revision-mismatch")
    changed = patch(client, {"threshold": 0.3})
    assert changed.json()["calibration"]["source"] == "manual"
    undone = patch(client, {"restore": measured}, changed.headers["ETag"])
    assert undone.json()["calibration"] == measured, "its source and what it rests on are back as well"
    assert client.get(HALL).json()["calibration"] == measured


@pytest.mark.parametrize(
    "calibration",
    [
        {"restore": PERSON, "threshold": 0.1},
        {"restore": PERSON, "measured_at": "2026-11-28T10:00:00Z"},
        {"restore": {}},
        {"restore": PERSON | {"threshold": None}},
        {"restore": PERSON | {"curve": {"slope": -1, "intercept": 0}}},
        {"restore": PERSON | {"more": 1}},
    ],
)
def test_what_cannot_be_put_back(client: TestClient, calibration: dict[str, Any]) -> None:
    assert_problem(patch(client, calibration), 422, "invalid-request")
    assert client.get(HALL).json()["calibration"] == PERSON
