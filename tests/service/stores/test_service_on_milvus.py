"""The service on PostgreSQL and Milvus: outages and their ends, secrets, maps that move, and two services."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from tests.servers.milvus import Servers
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem, typed
from tests.service.stores.door import Door

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]

PASSWORD, TOKEN = "a-password-to-hide", "root:a-token-to-hide"


@dataclass
class Place:
    """A service whose Milvus is behind a door, and one on the same store that reaches it directly."""

    service: Server
    other: Server
    door: Door

    def ready_by(self, status: int) -> httpx.Response:
        """The answer of /readyz, when it has this status."""
        until = time.monotonic() + 60
        while (answer := self.service.client.get("/readyz")).status_code != status and time.monotonic() < until:
            time.sleep(0.2)
        assert answer.status_code == status, answer.text
        return answer


@pytest.fixture(scope="module")
def place(servers: Servers, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    door = Door(servers.milvus_address)
    postgres = servers.postgres_address.replace("placerec@", f"placerec:{PASSWORD}@")
    services = []
    for name, milvus in (("service", door.address), ("other", servers.milvus_address)):
        folder = tmp_path_factory.mktemp(name)
        install_coarse_encoder(folder / "models")
        settings = {
            "vectors": "milvus",
            "milvus": milvus,
            "milvus_token": TOKEN,
            "database": postgres,
            "encoder": COARSE,
        }
        services.append(Server(folder, settings))
    place = Place(services[0], services[1], door)
    services[1].wait()
    services[0].wait("/livez")
    yield place
    for map_id in [one["id"] for one in place.other.client.get("/v1/maps").json()["items"]]:
        assert place.other.client.delete(f"/v1/maps/{map_id}").status_code == 204
    assert [service.stop() for service in services] == [0, 0]
    door.shut()


def test_a_milvus_that_is_gone_at_the_start_and_later(place: Place) -> None:
    service = place.service
    checks = place.ready_by(503).json()["checks"]
    assert "Milvus cannot be reached" in checks["maps"] and checks["disk"] == "ok"
    assert service.lines(level="error") and "Milvus" in str(service.lines(level="error")[0])

    service.create_map("gone")  # PostgreSQL is there
    refused = service.enrol("gone", "p1", jpeg(1))
    assert_problem(refused, 503, "store-unavailable")
    assert int(refused.headers["Retry-After"]) > 0
    assert service.client.get("/metrics").status_code == 200 and service.places("gone") == {}

    place.door.open()
    assert place.ready_by(200).json()["checks"]["maps"] == "ok"
    assert service.enrol("gone", "p1", jpeg(1)).status_code == 201
    assert service.query("gone", jpeg(1))["matches"][0]["place"]["id"] == "p1"

    place.door.shut()
    refused = service.client.post("/v1/maps/gone/query", content=jpeg(1), headers=typed(jpeg(1)))
    assert_problem(refused, 503, "store-unavailable")
    assert int(refused.headers["Retry-After"]) > 0
    place.ready_by(503)
    assert list(service.places("gone")) == ["p1"]
    assert list(place.other.places("gone")) == ["p1"]

    place.door.open()
    place.ready_by(200)
    assert service.query("gone", jpeg(1))["matches"][0]["place"]["id"] == "p1"


def test_secrets_are_shown_nowhere(place: Place) -> None:
    state = place.service.client.get("/v1/service")
    assert state.json()["settings"]["vectors"] == "milvus"
    for text in (state.text, place.service.log_file.read_text(), place.other.log_file.read_text()):
        assert PASSWORD not in text and "a-token-to-hide" not in text


def test_what_one_service_writes_the_other_finds_next(place: Place) -> None:
    place.ready_by(200)
    place.service.create_map("both", same_place_radius=0)
    for number, service in enumerate([place.service, place.other] * 2):
        assert service.enrol("both", f"p{number}", jpeg(number), x=number, y=0).status_code == 201
        reader = place.other if service is place.service else place.service
        assert reader.query("both", jpeg(number))["matches"][0]["place"]["id"] == f"p{number}"
    etag = place.service.client.get("/v1/maps/both").headers["ETag"]
    assert place.other.client.patch("/v1/maps/both", json={"description": "other"}).status_code == 200
    stale = place.service.client.patch("/v1/maps/both", json={"description": "mine"}, headers={"If-Match": etag})
    assert_problem(stale, 412, "revision-mismatch")
    assert place.service.client.get("/v1/maps/both").json()["description"] == "other"


def test_a_map_moves_between_the_stores_over_http(place: Place, tmp_path: Path) -> None:
    install_coarse_encoder(tmp_path / "models")
    embedded = Server(tmp_path, {"encoder": COARSE}).wait()
    embedded.create_map("moves", keep="image", verification=True)
    for number in range(6):
        response = embedded.enrol("moves", f"p{number}", jpeg(number), x=2 * number, y=0, sequence="monday")
        assert response.status_code == 201, response.text
    tar = {"Content-Type": "application/x-tar"}
    first = embedded.client.get("/v1/maps/moves/export")
    made = place.other.client.post("/v1/maps/import", content=first.content, headers=tar)
    assert made.status_code == 201, made.text
    second = place.other.client.get("/v1/maps/moves/export")
    assert second.content == first.content and second.headers["ETag"] == first.headers["ETag"]
    unchanged = place.other.client.get("/v1/maps/moves/export", headers={"If-None-Match": second.headers["ETag"]})
    assert unchanged.status_code == 304
    again = embedded.client.post("/v1/maps/import", params={"id": "back"}, content=second.content, headers=tar)
    assert again.status_code == 201, again.text
    for number in (0, 3, 9):
        here, there, back = (
            server.query(map_id, jpeg(number), k=6)
            for server, map_id in ((embedded, "moves"), (place.other, "moves"), (embedded, "back"))
        )
        for other in (there, back):
            assert other["verdict"] == here["verdict"]
            assert [match["place"]["id"] for match in other["matches"]] == [
                match["place"]["id"] for match in here["matches"]
            ]
            scores = [[match["score"] for match in one["matches"]] for one in (here, other)]
            assert scores[1] == pytest.approx(scores[0], abs=1e-5)
    taken = place.other.client.post("/v1/maps/import", content=first.content, headers=tar)
    assert_problem(taken, 409, "map-exists")
    assert embedded.stop() == 0


def test_work_on_whole_maps(place: Place) -> None:
    """Jobs that other stores do too: verification, rebuilding, merging, alignment's report, pruning's dry run."""
    client, service = place.other.client, place.other
    service.create_map("work", keep="thumbnail")
    service.create_map("more")
    for number in range(4):
        for map_id, name, seed, sequence in (("work", "p", number, "a"), ("more", "q", 10 + number, "b")):
            made = service.enrol(map_id, f"{name}{number}", jpeg(seed), x=2 * number, y=0, sequence=sequence)
            assert made.status_code == 201, made.text
    report = client.post("/v1/maps/work/verify").json()
    assert report["ok"] and report["places"] == 4

    def done(path: str, body: dict[str, object] | None = None) -> dict[str, object]:
        submitted = client.post(path) if body is None else client.post(path, json=body)
        assert submitted.status_code == 202, submitted.text
        until = time.monotonic() + 60
        while (job := client.get(submitted.headers["Location"]).json())["state"] in ("queued", "running"):
            assert time.monotonic() < until, job
            time.sleep(0.1)
        assert job["state"] == "succeeded", job
        result: dict[str, object] = job["result"]
        return result

    done("/v1/maps/work/rebuild")
    assert done("/v1/maps/work/merge", {"from": "more", "dry_run": False, "sample": 2})["places"] == 8
    assert list(service.places("work")) == [*(f"p{n}" for n in range(4)), *(f"q{n}" for n in range(4))]
    assert service.query("work", jpeg(12))["matches"][0]["place"]["id"] == "q2"
    plan = client.get("/v1/maps/work/plan").json()
    assert plan["ids"] == list(service.places("work")) and plan["sequences"] == ["a", "b"]
