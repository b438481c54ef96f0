"""Sessions on disk."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings

from service.sessions.store import FILE, SessionStore, StoredSession
from tests.service.sessions.contract import STEPS, check_records

ONE = StoredSession("s-1", "lab", "2026", "{}", 1.0, 2.0, 7, 3.5, "robot", 0, None, b"state", "{}")


def test_sessions_are_read_as_they_were_written(tmp_path: Path) -> None:
    store = SessionStore(tmp_path)
    store.write(ONE)
    other = SessionStore(tmp_path)  # as after a crash: nothing was closed
    assert other.read("s-1") == ONE and other.read("s-2") is None
    (head,) = other.all()
    assert (head.id, head.number, head.state, head.answer) == ("s-1", 7, None, None)
    assert other.renew(replace(ONE, number=8)) and not other.renew(replace(ONE, id="s-2"))
    renewed = store.read("s-1")
    assert renewed is not None and renewed.number == 8
    other.end("s-1", "over", 9.0)
    assert not store.renew(ONE), "a frame that was under way does not bring it back"
    ended = store.read("s-1")
    assert ended is not None and (ended.ended, ended.used, ended.state) == ("over", 9.0, None)
    store.forget("s-1")
    assert other.all() == []
    store.close()
    other.close()
    with pytest.raises(sqlite3.Error):
        store.write(ONE)


@pytest.mark.thorough
@settings(max_examples=20, deadline=None)
@given(STEPS)
def test_contract(tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, str, int, bytes]]) -> None:
    store = SessionStore(tmp_path_factory.mktemp("store"))
    check_records(store, steps)
    store.close()


@pytest.mark.parametrize("damage", ["bytes", "version", "table"])
def test_a_file_that_cannot_be_read_is_put_aside(tmp_path: Path, damage: str) -> None:
    store = SessionStore(tmp_path)
    store.write(ONE)
    store.close()
    path = tmp_path / FILE
    if damage == "bytes":
        path.write_bytes(b"not a database at all" * 500)
    else:
        with sqlite3.connect(path) as connection:
            connection.execute("PRAGMA user_version = 99" if damage == "version" else "DROP TABLE sessions")
        connection.close()
    again = SessionStore(tmp_path)
    assert again.all() == [] and list(tmp_path.glob(f"{FILE}.damaged-*"))
    again.write(ONE)
    assert again.read("s-1") == ONE
    again.close()
