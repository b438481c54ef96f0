"""Backups over HTTP: the schedule, one by request, who may, and a service that is killed while it makes one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from service.access.keys import Keys
from tests.service.map_jobs import finished, reaching, wait_until
from tests.service.scenes import jpeg
from tests.service.server import Server


@pytest.fixture(scope="module")
def saving(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with keys, a folder for backups and a map."""
    folder = tmp_path_factory.mktemp("saving")
    store = Keys.of(folder / "data")
    _, key = store.create("ann", "admin")
    server = Server(folder, {"backup_dir": folder / "backups"}, key=key).wait()
    server.create_map("lab")
    assert server.enrol("lab", "p", jpeg(0)).status_code == 201
    yield server
    assert server.stop() == 0


def slug(answer: httpx.Response) -> str:
    return str(answer.json()["type"]).rpartition(":")[2]


def test_all_maps_are_saved_by_themselves_and_by_request(saving: Server) -> None:
    wait_until(lambda: len(saving.client.get("/v1/backups").json()["items"]) > 0)  # at the start
    told = saving.client.put("/v1/backups/schedule", json={"hours": None, "keep": 2}).json()
    assert (told["enabled"], told["schedule"], told["next_at"]) == (True, {"hours": None, "keep": 2}, None)
    accepted = saving.client.post("/v1/backups")
    assert accepted.status_code == 202 and accepted.headers["Location"] == f"/v1/jobs/{accepted.json()['id']}"
    result = finished(saving, accepted.json())["result"]
    told = saving.client.get("/v1/backups").json()
    assert told["items"][0] | {"bytes": 0, "at": 0} == {
        "id": result["backup"], "at": 0, "maps": 1, "places": 1, "bytes": 0,
    }  # fmt: skip
    assert (told["running"], told["problem"], told["next_cursor"]) == (None, None, None)
    assert "placerec_last_backup_timestamp_seconds 1." in saving.client.get("/metrics").text
    audited = saving.client.get("/v1/audit", params={"operation": "schedule_backups"}).json()["items"]
    assert {one["principal"] for one in audited} == {"ann"}


@pytest.mark.parametrize("order", [{"hours": 0}, {"hours": "daily"}, {"keep": 0}, {"keep": 1.5}, {"folder": "/"}])
def test_a_schedule_that_is_none_is_refused(saving: Server, order: dict[str, object]) -> None:
    before = saving.client.get("/v1/backups").json()["schedule"]
    refused = saving.client.put("/v1/backups/schedule", json=order)
    assert (refused.status_code, slug(refused)) == (422, "invalid-request"), refused.text
    assert saving.client.get("/v1/backups").json()["schedule"] == before


def test_only_an_admin_for_all_maps_may(saving: Server) -> None:
    for role, maps in (("enrol", None), ("admin", ["lab"])):
        made = saving.client.post("/v1/keys", json={"name": f"{role}-of-some", "role": role, "maps": maps}).json()
        headers = {"Authorization": f"Bearer {made['key']}"}
        for method, path in (("GET", ""), ("POST", ""), ("PUT", "/schedule")):
            body = {"hours": 1} if method == "PUT" else None
            answer = saving.client.request(method, f"/v1/backups{path}", headers=headers, json=body)
            assert answer.status_code == 403, (role, method)


def test_without_a_folder_that_is_said(server: Server) -> None:
    told = server.client.get("/v1/backups").json()
    assert (told["enabled"], told["schedule"], told["items"]) == (False, None, [])
    for refused in (server.client.post("/v1/backups"), server.client.put("/v1/backups/schedule", json={"hours": 1})):
        assert (refused.status_code, slug(refused)) == (409, "backup-folder-missing")


@pytest.mark.thorough
def test_a_service_that_is_killed_while_it_saves_goes_on(tmp_path: Path) -> None:
    settings = {"backup_dir": tmp_path / "backups"}
    server = Server(tmp_path, settings).wait()
    server.create_map("m0", keep="image")
    assert server.enrol("m0", "p", jpeg(0)).status_code == 201
    wait_until(lambda: len(server.client.get("/v1/backups").json()["items"]) > 0)
    content = server.client.get("/v1/maps/m0/export").content
    for number in range(1, 40):
        made = server.client.post("/v1/maps/import", params={"id": f"m{number}"}, content=content,
                                  headers={"Content-Type": "application/x-tar"})  # fmt: skip
        assert made.status_code == 201, made.text
    job = reaching(server, server.client.post("/v1/backups").json(), 3)
    server.kill()
    again = Server(tmp_path, settings).wait()
    ended = finished(again, job)
    assert ended["state"] == "succeeded", ended
    newest = again.client.get("/v1/backups").json()["items"][0]
    assert (newest["id"], newest["maps"]) == (ended["result"]["backup"], 40)
    assert not list((tmp_path / "backups").glob(".*"))
    assert again.stop() == 0
