"""The audit trail over HTTP: newest first, in pages, with filters, from the file or from memory."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.access.keys import Keys
from service.administration import audit_routes
from service.administration.audit_lines import lines_of_files
from service.administration.audit_routes import AuditParameters
from tests.service.server import Server, assert_problem
from tests.service.wire import eventually


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service with keys and a file for its trail."""
    folder = tmp_path_factory.mktemp("audited")
    store = Keys.of(folder / "data")
    _, token = store.create("ops", "admin")
    running = Server(folder, settings={"audit_file": folder / "audit.jsonl"}, key=token).wait()
    yield running
    assert running.stop() == 0


def all_entries(client: httpx.Client, **parameters: str) -> list[dict[str, Any]]:
    """Every entry, over all pages."""
    found: list[dict[str, Any]] = []
    cursor: str | None = ""
    while cursor is not None:
        page = client.get("/v1/audit", params=parameters | ({"cursor": cursor} if cursor else {})).json()
        found += page["items"]
        cursor = page["next_cursor"]
    return found


def test_who_changed_what_newest_first(keyed: Server) -> None:
    began = datetime.now(UTC)
    names = [f"audited-{number}" for number in range(5)]
    for name in names:
        keyed.create_map(name)
    keyed.client.patch("/v1/maps/audited-0", json={"description": "x"}, headers={"X-Request-Id": "the-edit"})
    keyed.client.delete("/v1/maps/absent")
    refused = httpx.get(f"{keyed.client.base_url}/v1/maps", headers={"Authorization": "Bearer nonsense"})
    assert refused.status_code == 401
    assert eventually(lambda: len(all_entries(keyed.client, after=began.isoformat())) == 8)
    entries = all_entries(keyed.client, after=began.isoformat())
    assert [entry["time"] for entry in entries] == sorted((entry["time"] for entry in entries), reverse=True)
    assert all_entries(keyed.client, after=began.isoformat(), limit="3") == entries
    (edit,) = (entry for entry in entries if entry["request_id"] == "the-edit")
    assert (edit["event"], edit["operation"], edit["status"], edit["map"]) == ("change", "edit_map", 200, "audited-0")
    assert edit["principal"] == "ops" and edit["client"] == "127.0.0.1" and edit["key"]
    assert "logger" not in edit and "level" not in edit and "message" not in edit
    lines = [json.loads(line) for line in (keyed.folder / "audit.jsonl").read_text().splitlines()]
    assert len(all_entries(keyed.client)) == len(lines)
    assert [entry["map"] for entry in all_entries(keyed.client, map="audited-3")] == ["audited-3"]
    assert [entry["status"] for entry in all_entries(keyed.client, operation="delete_map")] == [404]
    assert all_entries(keyed.client, key="ops") == all_entries(keyed.client, key=edit["key"])
    assert {entry["event"] for entry in all_entries(keyed.client, key="nobody")} == {"refused"}
    assert all_entries(keyed.client, before="2020-01-01T00:00:00Z") == []
    page = keyed.client.get("/v1/audit").json()
    assert page["source"] == "file"


def test_a_trail_goes_on_where_it_was_moved_away(keyed: Server) -> None:
    keyed.create_map("before-move")
    assert eventually(lambda: len(all_entries(keyed.client, map="before-move")) == 1)
    first = keyed.client.get("/v1/audit", params={"limit": "1"}).json()
    (keyed.folder / "audit.jsonl").rename(keyed.folder / "audit.jsonl.1")
    keyed.create_map("after-move")
    assert eventually(lambda: len(all_entries(keyed.client, map="after-move")) == 1)
    assert len(all_entries(keyed.client, map="before-move")) == 1
    second = keyed.client.get("/v1/audit", params={"limit": "1", "cursor": first["next_cursor"]}).json()
    assert second["items"] and second["items"][0]["time"] <= first["items"][0]["time"]
    assert second["items"][0]["map"] != "after-move", "a line that came later shifts nothing"


def test_what_does_not_fit_is_refused(keyed: Server) -> None:
    assert_problem(keyed.client.get("/v1/audit", params={"cursor": "x"}), 422, "invalid-cursor")
    first = keyed.client.get("/v1/audit", params={"limit": "1"}).json()["next_cursor"]
    assert_problem(keyed.client.get("/v1/audit", params={"cursor": first, "map": "lab"}), 422, "invalid-cursor")
    wrong = ({"limit": "0"}, {"after": "soon"}, {"who": "me"}, {"after": "2026-01-02", "before": "2026-01-01"})
    for parameters in wrong:
        assert_problem(keyed.client.get("/v1/audit", params=parameters), 422, "invalid-request")


def test_without_a_file_the_latest_lines_are_in_memory(client: httpx.Client, map_id: str) -> None:
    for text in ("a", "b", "c"):
        client.patch(f"/v1/maps/{map_id}", json={"description": text})
    assert eventually(lambda: len(all_entries(client, map=map_id)) == 4)
    page = client.get("/v1/audit", params={"limit": "2"}).json()
    assert page["source"] == "memory" and len(page["items"]) == 2
    following = client.get("/v1/audit", params={"limit": "2", "cursor": page["next_cursor"]}).json()
    assert not {entry["request_id"] for entry in following["items"]} & {entry["request_id"] for entry in page["items"]}


def test_one_request_reads_a_bounded_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "audit.jsonl"
    line = {"message": "change", "operation": "edit_map"}
    lines = [line | {"time": f"2026-11-22T10:{number:02}:00Z", "map": f"m{number}"} for number in range(60)]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    monkeypatch.setattr(audit_routes, "MOST_READ", 500)
    items, reached = audit_routes._page(lines_of_files(path, None), AuditParameters(map="m0"))
    assert items == [] and reached is not None, "nothing was found yet, and there is more to read"
    pages = 1
    while reached is not None:
        items, reached = audit_routes._page(lines_of_files(path, reached), AuditParameters(map="m0"))
        pages += 1
    assert [item.map for item in items] == ["m0"] and pages > 5
