"""Keys over HTTP: created, narrowed, revoked, in force at once, and nobody is locked out by mistake."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.access.keys import Keys
from service.access.roles import TOKEN
from tests.service.server import Server, assert_problem
from tests.service.wire import eventually


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service with one key, of its administrator."""
    folder = tmp_path_factory.mktemp("keyed")
    (folder / "data").mkdir()
    _, token = Keys.of(folder / "data").create("ops", "admin")
    running = Server(folder, settings={"audit_file": folder / "audit.jsonl"}, key=token).wait()
    running.create_map("lab")
    running.create_map("yard")
    yield running
    assert running.stop() == 0


def created(server: Server, name: str, role: str = "query", **more: Any) -> dict[str, Any]:
    """A new key, with its secret."""
    response = server.client.post("/v1/keys", json={"name": name, "role": role, **more})
    assert response.status_code == 201, response.text
    assert response.headers["location"] == f"/v1/keys/{response.json()['id']}"
    assert response.headers["cache-control"] == "no-store"
    made: dict[str, Any] = response.json()
    return made


def asking(server: Server, token: str) -> httpx.Client:
    """A client with another key."""
    return httpx.Client(base_url=server.client.base_url, headers={"Authorization": f"Bearer {token}"}, timeout=60)


def test_a_new_key_works_at_once_and_its_secret_is_shown_once(keyed: Server) -> None:
    made = created(keyed, "robot-1", maps=["lab"], expires_at="2099-01-31T00:00:00+01:00")
    assert TOKEN.fullmatch(made["key"]) and made["key"].startswith(f"placerec_{made['id']}_")
    assert made["expires_at"] == "2099-01-30T23:00:00Z" and made["state"] == "in force" and made["maps"] == ["lab"]
    with asking(keyed, made["key"]) as robot:
        assert robot.get("/v1/maps/lab").status_code == 200
        assert_problem(robot.get("/v1/maps/yard"), 403, "map-forbidden")
        assert robot.get("/v1/key").json() == {
            "id": made["id"],
            "name": "robot-1",
            "role": "query",
            "maps": ["lab"],
            "learn": False,
            "expires_at": "2099-01-30T23:00:00Z",
            "keys_needed": True,
        }
        assert_problem(robot.get("/v1/keys"), 403, "role-too-low")
    read = keyed.client.get(f"/v1/keys/{made['id']}")
    assert read.json() == {name: value for name, value in made.items() if name != "key"} | {
        "last_used_at": read.json()["last_used_at"]
    }
    secret = made["key"].split("_", 2)[2]
    for text in (read.text, keyed.client.get("/v1/keys").text, keyed.log_file.read_text()):
        assert secret not in text
    assert secret not in (keyed.folder / "audit.jsonl").read_text()


def test_keys_are_listed_in_pages_oldest_first(keyed: Server) -> None:
    for number in range(3):
        created(keyed, f"listed-{number}")
    found, cursor = [], None
    while True:
        page = keyed.client.get("/v1/keys", params={"limit": "2", **({"cursor": cursor} if cursor else {})}).json()
        found += page["items"]
        cursor = page["next_cursor"]
        if cursor is None:
            break
        assert len(page["items"]) == 2
    assert found == keyed.client.get("/v1/keys").json()["items"]
    assert found[0]["name"] == "ops" and [key["own"] for key in found].count(True) == 1 and found[0]["own"]
    assert [key["created_at"] for key in found] == sorted(key["created_at"] for key in found)
    assert_problem(keyed.client.get("/v1/keys", params={"cursor": "x"}), 422, "invalid-cursor")


def test_a_revoked_key_lets_nobody_in_from_the_next_request_on(keyed: Server) -> None:
    made = created(keyed, "robot-2")
    with asking(keyed, made["key"]) as robot:
        assert robot.get("/v1/maps").status_code == 200
        first = keyed.client.delete(f"/v1/keys/{made['id']}")
        assert first.status_code == 200 and first.json()["state"] == "revoked"
        assert_problem(robot.get("/v1/maps"), 401, "key-refused")
    again = keyed.client.delete(f"/v1/keys/{made['id']}").json()
    assert again["revoked_at"] == first.json()["revoked_at"]
    assert_problem(keyed.client.patch(f"/v1/keys/{made['id']}", json={"role": "query"}), 409, "key-ended")
    for unknown in ("000000000000", "robot-2"):
        assert_problem(keyed.client.delete(f"/v1/keys/{unknown}"), 404, "unknown-key")
        assert_problem(keyed.client.get(f"/v1/keys/{unknown}"), 404, "unknown-key")
        assert_problem(keyed.client.patch(f"/v1/keys/{unknown}", json={}), 404, "unknown-key")
    assert created(keyed, "robot-2")["id"] != made["id"], "its name is free again"
    assert_problem(keyed.client.post("/v1/keys", json={"name": "robot-2", "role": "query"}), 409, "key-exists")


def test_a_key_says_whether_maps_learn_from_its_runs(keyed: Server) -> None:
    made = created(keyed, "teacher", "enrol", learn=True)
    path = f"/v1/keys/{made['id']}"
    with asking(keyed, made["key"]) as robot:
        assert made["learn"] and robot.get("/v1/key").json()["learn"]
        assert keyed.client.patch(path, json={"learn": False}).json()["learn"] is False
        assert not robot.get("/v1/key").json()["learn"]
    assert_problem(keyed.client.patch(path, json={"learn": True}), 409, "key-widened")
    assert_problem(keyed.client.patch(path, json={"learn": None}), 422, "invalid-request")
    query = {"name": "asker", "role": "query", "learn": True}
    assert_problem(keyed.client.post("/v1/keys", json=query), 422, "invalid-request")


def test_a_key_is_narrowed_at_once_and_never_widened(keyed: Server) -> None:
    made = created(keyed, "robot-3", "enrol", maps=["lab", "yard"])
    path = f"/v1/keys/{made['id']}"
    soon = datetime.now(UTC).replace(microsecond=0) + timedelta(days=1)
    with asking(keyed, made["key"]) as robot:
        assert robot.get("/v1/maps/yard").status_code == 200
        changed = keyed.client.patch(path, json={"role": "query", "maps": ["lab"]}).json()
        assert (changed["role"], changed["maps"], changed["expires_at"]) == ("query", ["lab"], None)
        assert_problem(robot.get("/v1/maps/yard"), 403, "map-forbidden")
        assert_problem(robot.delete("/v1/maps/lab/places/p"), 403, "role-too-low")
        assert keyed.client.patch(path, json={"expires_at": soon.isoformat()}).status_code == 200
    wider: list[dict[str, Any]] = [
        {"role": "enrol"},
        {"role": "admin"},
        {"maps": None},
        {"maps": ["lab", "yard"]},
        {"maps": ["yard"]},
        {"expires_at": None},
        {"expires_at": (soon + timedelta(seconds=1)).isoformat()},
    ]
    for change in wider:
        assert_problem(keyed.client.patch(path, json=change), 409, "key-widened")
    refused: list[dict[str, Any]] = [
        {"role": None},
        {"expires_at": "2020-01-01T00:00:00Z"},
        {"name": "x"},
        {"maps": []},
    ]
    for change in refused:
        assert_problem(keyed.client.patch(path, json=change), 422, "invalid-request")
    assert_problem(keyed.client.patch(path, content=b"{}"), 415, "unsupported-media-type")
    assert keyed.client.get(path).json() == changed | {
        "expires_at": soon.isoformat().replace("+00:00", "Z"),
        "last_used_at": keyed.client.get(path).json()["last_used_at"],
    }


def test_what_cannot_be_a_key_is_refused(keyed: Server) -> None:
    before = len(keyed.client.get("/v1/keys").json()["items"])
    wrong: list[dict[str, Any]] = [
        {"name": "two words", "role": "query"},
        {"name": "owner", "role": "query"},
        {"name": "x", "role": "open"},
        {"name": "x", "role": "query", "expires_at": "2020-01-01T00:00:00Z"},
        {"name": "x", "role": "query", "maps": []},
        {"name": "x", "role": "query", "maps": ["a" * 300_000]},
        {"name": "x", "role": "query", "rate": 3},
        {"name": "x"},
    ]
    for body in wrong:
        assert_problem(keyed.client.post("/v1/keys", json=body), 422, "invalid-request")
    bad = {"name": "x", "role": "query", "maps": ["Not A Map"]}
    assert_problem(keyed.client.post("/v1/keys", json=bad), 422, "invalid-identifier")
    assert len(keyed.client.get("/v1/keys").json()["items"]) == before


def test_the_last_administrator_is_not_locked_out_by_mistake(keyed: Server) -> None:
    (ops,) = (key for key in keyed.client.get("/v1/keys").json()["items"] if key["own"])
    created(keyed, "of-lab", "admin", maps=["lab"])  # cannot manage keys
    path = f"/v1/keys/{ops['id']}"
    assert_problem(keyed.client.delete(path), 409, "last-admin-key")
    assert_problem(keyed.client.patch(path, json={"role": "enrol"}), 409, "last-admin-key")
    assert_problem(keyed.client.patch(path, json={"maps": ["lab"]}), 409, "last-admin-key")
    assert keyed.client.get(path).json()["state"] == "in force"
    second = created(keyed, "second", "admin")
    with asking(keyed, second["key"]) as other:
        assert other.delete(f"/v1/keys/{second['id']}").json()["own"], "the other one remains"
        assert_problem(other.get("/v1/keys"), 401, "key-refused")


def test_changes_are_in_the_audit_trail_with_who_made_them(keyed: Server) -> None:
    (ops,) = (key for key in keyed.client.get("/v1/keys").json()["items"] if key["own"])
    made = created(keyed, "audited", maps=["lab", "yard"])
    path = f"/v1/keys/{made['id']}"
    keyed.client.patch(path, json={"maps": ["lab"]})
    keyed.client.patch(path, json={"maps": None})
    keyed.client.delete(path)

    def told() -> list[dict[str, Any]]:
        lines = [json.loads(line) for line in (keyed.folder / "audit.jsonl").read_text().splitlines()]
        return [line for line in lines if line.get("changed_key") == made["id"]]

    assert eventually(lambda: len(told()) == 4), "a line is written when its answer is on its way"
    of_key = told()
    assert [(line["operation"], line["status"]) for line in of_key] == [
        ("create_key", 201),
        ("narrow_key", 200),
        ("narrow_key", 409),
        ("delete_key", 200),
    ]
    for line in of_key:
        assert (line["principal"], line["key"]) == ("ops", ops["id"])
    assert (of_key[0]["role"], of_key[1]["maps"]) == ("query", ["lab"])
    assert all(line["changed_key_name"] == "audited" for line in of_key if line["status"] < 400)


def test_the_first_key_of_an_open_service_turns_keys_on(tmp_path: Path) -> None:
    server = Server(tmp_path).wait()
    try:
        assert server.client.get("/v1/key").json() == {
            "id": None,
            "name": "anonymous",
            "role": "admin",
            "maps": None,
            "learn": True,
            "expires_at": None,
            "keys_needed": False,
        }
        for body in ({"name": "robot", "role": "query"}, {"name": "robot", "role": "admin", "maps": ["lab"]}):
            assert_problem(server.client.post("/v1/keys", json=body), 409, "last-admin-key")
        assert server.client.get("/v1/keys").json()["items"] == [], "and the service is open still"
        foreign = {"Origin": "http://elsewhere.example"}
        body = {"name": "ops", "role": "admin"}
        assert_problem(server.client.post("/v1/keys", json=body, headers=foreign), 403, "foreign-page")
        made = created(server, "ops", "admin")
        assert_problem(server.client.get("/v1/maps"), 401, "key-needed")
        with asking(server, made["key"]) as ops:
            assert ops.get("/v1/maps").status_code == 200
            gone = ops.delete(f"/v1/keys/{made['id']}", params={"lock_out": "true"})
            assert gone.json()["state"] == "revoked"
            assert_problem(ops.get("/v1/keys"), 401, "key-refused")
        assert Keys.of(server.data_dir).create("again", "admin")[0].name == "again", "the command line still can"
    finally:
        assert server.stop() == 0


@pytest.mark.thorough
def test_a_first_key_may_lock_everybody_out_if_that_is_said(tmp_path: Path) -> None:
    server = Server(tmp_path).wait()
    try:
        made = server.client.post("/v1/keys", params={"lock_out": "true"}, json={"name": "robot", "role": "query"})
        assert made.status_code == 201
        with asking(server, made.json()["key"]) as robot:
            assert robot.get("/v1/maps").status_code == 200
            assert_problem(robot.get("/v1/keys"), 403, "role-too-low")
    finally:
        assert server.stop() == 0


@pytest.mark.thorough
def test_other_machines_cannot_create_the_first_key(tmp_path: Path) -> None:
    # Written like this the address does not count as this machine's own, although it is.
    server = Server(tmp_path, settings={"host": "127.1", "allow_anonymous": "true"}).wait()
    try:
        body = {"name": "ops", "role": "admin"}
        assert_problem(server.client.post("/v1/keys", json=body), 403, "first-key-local")
        assert server.client.get("/v1/maps").status_code == 200
        _, token = Keys.of(server.data_dir).create("ops", "admin")
        with asking(server, token) as ops:
            assert eventually(lambda: ops.get("/v1/key").json().get("keys_needed") is True)
            assert ops.post("/v1/keys", json={"name": "other", "role": "query"}).status_code == 201
    finally:
        assert server.stop() == 0
