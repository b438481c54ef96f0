"""``placerec keys``, and the key that other commands send."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import typer.main

from placerec_client.problems import KeyNeeded
from service.access.keys import Keys
from service.access.roles import TOKEN
from service.commands.application import application
from service.commands.connection.client import Refused, failures
from service.commands.connection.credentials import is_unencrypted
from service.commands.console import Failure
from service.commands.keys import moment
from service.commands.load import request
from tests.service.commands.conftest import Placerec


def test_a_key_is_shown_once(placerec: Placerec, tmp_path: Path) -> None:
    limits = ("--map", "lab", "--map", "yard", "--expires", "30d")
    made = placerec("keys", "create", "robot-7", "--role", "query", *limits, "--lock-out")
    token = made.stdout.strip()
    assert TOKEN.fullmatch(token), "all of standard output, for a script"
    assert "From now on every request needs a key" in made.stderr and token not in made.stderr
    other = json.loads(placerec("keys", "create", "ann", "--role", "admin", "--json").stdout)
    assert TOKEN.fullmatch(other["key"]) and (other["maps"], other["expires_at"]) == (None, None)
    first, second = json.loads(placerec("keys", "list", "--json").stdout)
    assert (first["name"], first["maps"], first["state"]) == ("robot-7", ["lab", "yard"], "in force")
    left = datetime.fromisoformat(first["expires_at"]) - datetime.now(UTC)
    assert timedelta(days=29, hours=23) < left <= timedelta(days=30)
    table = placerec("keys", "list").stdout
    assert "robot-7" in table and token not in table and token[-43:] not in table
    placerec("keys", "delete", "robot-7")
    told = placerec("keys", "delete", second["id"]).stderr
    assert "No key is in force" in told
    assert [key["state"] for key in json.loads(placerec("keys", "list", "--json").stdout)] == ["revoked"] * 2
    assert (tmp_path / "data" / "keys.sqlite").exists() and not (tmp_path / "data" / "maps").exists()


def test_the_first_key_can_manage_the_service(placerec: Placerec, tmp_path: Path) -> None:
    for robot in (("--role", "query"), ("--role", "admin", "--map", "lab")):
        refused = placerec("keys", "create", "robot-7", *robot, status=1)
        assert "Create an admin key for all maps first" in refused.stderr and not refused.stdout
    assert not (tmp_path / "data" / "keys.sqlite").exists(), "the service still needs no key"
    placerec("keys", "create", "ann", "--role", "admin")
    placerec("keys", "create", "robot-7", "--role", "query")
    assert [key["name"] for key in json.loads(placerec("keys", "list", "--json").stdout)] == ["ann", "robot-7"]


def test_a_map_that_is_not_there_is_named(placerec: Placerec) -> None:
    placerec("maps", "create", "lab")
    placerec("keys", "create", "ann", "--role", "admin")
    told = placerec("keys", "create", "robot-7", "--role", "query", "--map", "lab", "--map", "lob").stderr
    assert "There is no map lob yet" in told and "no map lab" not in told


def test_the_audit_file_knows_the_keys_of_the_command_line(
    placerec: Placerec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLACEREC_AUDIT_FILE", str(tmp_path / "audit.jsonl"))
    token = placerec("keys", "create", "robot-7", "--role", "enrol", "--map", "lab", "--lock-out").stdout.strip()
    placerec("keys", "delete", "robot-7")
    written = (tmp_path / "audit.jsonl").read_text()
    created, deleted = map(json.loads, written.splitlines())
    assert token not in written and created["changed_key"] == deleted["changed_key"] == token.split("_")[1]
    for line, operation, status in ((created, "create_key", 201), (deleted, "delete_key", 200)):
        told = (line["message"], line["principal"], line["operation"], line["changed_key_name"], line["status"])
        assert told == ("change", "owner", operation, "robot-7", status)
    assert (created["role"], created["maps"]) == ("enrol", ["lab"])


def test_what_cannot_be_done_ends_in_a_sentence(placerec: Placerec, tmp_path: Path) -> None:
    assert "No key was ever created" in placerec("keys", "list").stderr
    assert "No key was ever created" in placerec("keys", "delete", "ann", status=1).stderr
    placerec("keys", "create", "ann", "--role", "root", status=2)
    assert (
        "neither a span" in placerec("keys", "create", "ann", "--role", "query", "--expires", "soon", status=1).stderr
    )
    Keys.of(tmp_path / "data").create("ann", "admin")
    assert "already" in placerec("keys", "create", "ann", "--role", "query", status=1).stderr
    (tmp_path / "data" / "keys.sqlite").write_bytes(b"no database")
    for words in (("list",), ("delete", "ann"), ("create", "bob", "--role", "query")):
        assert "keys.sqlite" in placerec("keys", *words, status=1).stderr


def test_spans_and_dates() -> None:
    now = datetime.now(UTC)
    assert moment("2030-01-31") == datetime(2030, 1, 31, tzinfo=UTC)
    assert moment("2030-01-31T12:00:00+02:00") == datetime(2030, 1, 31, 10, tzinfo=UTC)
    for text, span in (("90m", timedelta(minutes=90)), ("12h", timedelta(hours=12)), ("2w", timedelta(weeks=2))):
        assert abs(moment(text) - now - span) < timedelta(seconds=30)
    for text in ("", "30", "30y", "d", "-1d", "tomorrow"):
        with pytest.raises(Failure):
            moment(text)


def test_every_command_that_talks_to_a_service_takes_a_key() -> None:
    found = {True: 0, False: 0}

    def walk(command: object, path: str) -> None:
        if hasattr(command, "commands"):
            for name in command.commands:
                walk(command.get_command(None, name), f"{path} {name}")  # type: ignore[attr-defined]
            return
        options = {parameter.name for parameter in command.params}  # type: ignore[attr-defined]
        assert ("key" in options) == ("url" in options), path
        found["url" in options] += 1

    walk(typer.main.get_command(application), "placerec")
    assert found[True] > 20 and found[False] > 3


def test_a_wrong_key_is_not_repeated(placerec: Placerec, monkeypatch: pytest.MonkeyPatch) -> None:
    url = ("--url", "http://127.0.0.1:9")
    told = placerec("maps", "list", *url, "--key", "sesame", status=2).stderr
    assert "a key has the form" in told and "sesame" not in told
    key = "placerec_0123456789ab_" + "A" * 43
    monkeypatch.setenv("PLACEREC_KEY", key)
    told = placerec("maps", "list", *url, status=1).stderr
    assert "cannot be reached" in told and "AAAA" not in told and "encryption" not in told


def test_a_url_without_encryption() -> None:
    for url, openly in (
        ("http://10.0.0.7:8000", True),
        ("http://localhost.example", True),
        ("https://10.0.0.7", False),
        ("http://127.0.0.1:8000", False),
        ("http://[::1]:8000", False),
        ("http://localhost", False),
    ):
        assert is_unencrypted(url) is openly, url


def test_a_refusal_names_the_variable() -> None:
    with pytest.raises(Refused, match="PLACEREC_KEY"), failures():
        raise KeyNeeded({"type": "urn:placerec:problem:key-needed", "detail": "A key."}, 401)


def test_the_load_carries_the_key() -> None:
    assert b"\r\nAuthorization: Bearer k\r\n\r\nabc" in request("robot", "/v1/encode", b"abc", "k")
    assert b"Authorization" not in request("robot", "/v1/encode", b"abc")
