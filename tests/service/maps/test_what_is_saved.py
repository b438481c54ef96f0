"""What of a map is there again after it was exported and imported elsewhere, and what is not, kind by kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from core.judgement.trials import StagedTrials
from core.learning import Witness
from core.maps import Enrolment, ReviewSetting
from core.places import PlaceFields, look_address
from core.store import Map
from service.app.application import create_app
from service.queries.histories.run_trials import RunTrials
from service.queries.statistics import map_key
from service.settings import Settings
from tests.core.judgement.test_calibration import drawn
from tests.service.scenes import jpeg

HALL = "/v1/maps/hall"
SENT: dict[str, Any] = {"content": jpeg(0), "headers": {"Content-Type": "image/jpeg"}}


def hall(client: TestClient) -> Map:
    found: Map = client.app.state.engine.maps.get("hall")  # type: ignore[attr-defined]
    return found


def filled(client: TestClient) -> None:
    """Give the map ``hall`` something of every kind."""
    settings = {
        "description": "by the gate", "keep": "image", "same_place_radius": 2.5, "same_place_frames": 4,
        "review": {"verdicts": ["recognized", "unknown"], "most_frames": 77},
        "learning": {"mode": "propose", "most_looks": 4}, "alarms": {"worse_places": 3}, "index": "exact",
    }  # fmt: skip
    assert client.post("/v1/maps", json={"id": "hall"}).status_code == 201
    assert client.patch(HALL, json=settings | {"calibration": {"threshold": 0.2}}).status_code == 200
    mask = {"polygons": [[[0, 0.9], [1, 0.9], [1, 1], [0, 1]]]}
    assert client.put(f"{HALL}/cameras/front", json={"mask": mask}).status_code == 201
    assert client.put(f"{HALL}/places/p?sequence=monday&x=1&y=2&camera=front", **SENT).status_code == 201
    assert client.post(f"{HALL}/query", **SENT).status_code == 200
    map_, statistics = hall(client), client.app.state.statistics  # type: ignore[attr-defined]
    digest = bytes([7]) * 32
    rows = np.array(map_.rows_of(["p"]), np.int64)
    (vector,), (local,) = map_.snapshot().descriptors_at(rows), map_.snapshot().locals_at(rows)
    map_.enrol([Enrolment(look_address("p", digest.hex()[:16]), PlaceFields(), vector, 1, digest, local, run="s-1")])
    proposal: dict[str, Any] = {"verdict": "unknown", "camera": None, "proposal": {"place": "p", "run": "s-1"}}
    plain: dict[str, Any] = {"verdict": "unknown", "camera": "front"}
    for number, answer in enumerate((plain, proposal)):
        map_.review.keep(jpeg(20 + number), answer, ReviewSetting())
    (first, *_) = sorted(map_.review.page(None, 10).frames, key=lambda one: one.number)
    labelled = client.post(f"{HALL}/review/{first.number}", json={"place": "p"})
    assert labelled.status_code == 200, labelled.text
    said = RunTrials("s-1", Witness("robot", datetime.now(UTC)), StagedTrials.of(drawn(60)))
    statistics.keep_run_trials(map_key(map_), said)
    measured = client.post(f"{HALL}/calibrate", json={"method": "runs", "dry_run": True})
    assert measured.status_code == 200, measured.text


def shown(client: TestClient, path: str = "") -> Any:
    return client.get(f"{HALL}{path}").json()


def settings_of(client: TestClient) -> dict[str, Any]:
    found = shown(client)
    names = ("description", "keep", "same_place_radius", "same_place_frames", "verification", "learning", "alarms")
    return {name: found[name] for name in names} | {"index": found["index"]["setting"]}


def labels_of(client: TestClient) -> list[dict[str, Any]]:
    return [{**one, "id": None} for one in shown(client, "/review/labels")["items"]]


def without_labels(client: TestClient) -> list[str]:
    return [one["sha256"] for one in shown(client, "/review?labelled=false")["items"]]


def said_by_runs(client: TestClient) -> int:
    statistics = client.app.state.statistics  # type: ignore[attr-defined]
    return len(statistics.run_trials(map_key(hall(client))))


THINGS: dict[str, tuple[Callable[[TestClient], Any], bool]] = {
    "settings": (settings_of, True),
    "setting of the review": (lambda client: shown(client)["review"], True),
    "calibration": (lambda client: shown(client)["calibration"], True),
    "cameras": (lambda client: shown(client, "/cameras")["items"], True),
    "places": (lambda client: shown(client, "/places")["items"], True),
    "traverses": (lambda client: shown(client, "/sequences")["items"], True),
    "learnt looks": (lambda client: shown(client, "/looks")["items"], True),
    "pictures": (lambda client: client.get(f"{HALL}/places/p/thumbnail").content, True),
    "labels": (labels_of, True),
    "frames without a label": (without_labels, False),
    "measurement of the calibration": (lambda client: shown(client, "/calibration")["measured"], False),
    "answers of the last day": (lambda client: sum(shown(client)["last_day"].values()), False),
    "what runs said of the calibration": (said_by_runs, False),
}
"""How each kind of thing is read, and whether it is there again."""


@pytest.fixture(scope="module")
def before_and_after(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """All things of a map, where it was exported, and in another service that imported it."""
    folder = tmp_path_factory.mktemp("saved")
    with TestClient(create_app(Settings(data_dir=folder / "one"), as_owner=True)) as client:
        filled(client)
        before = {name: read(client) for name, (read, _) in THINGS.items()}
        file = client.get(f"{HALL}/export").content
    with TestClient(create_app(Settings(data_dir=folder / "other"), as_owner=True)) as client:
        made = client.post("/v1/maps/import", content=file, headers={"Content-Type": "application/x-tar"})
        assert made.status_code == 201, made.text
        yield before, {name: read(client) for name, (read, _) in THINGS.items()}


@pytest.mark.parametrize("thing", THINGS)
def test_a_thing_of_a_map_is_saved_or_not(before_and_after: tuple[dict[str, Any], dict[str, Any]], thing: str) -> None:
    before, after = (told[thing] for told in before_and_after)
    assert before, "there is something to lose"
    if THINGS[thing][1]:
        assert after == before
    else:
        assert not after
