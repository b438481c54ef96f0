"""The table of the sessions is the same in a file and in PostgreSQL."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import bindparam, update

from core.ledger import Ledger, Statement
from service.access.audit import Asker
from service.errors.faults import TooManySessions
from service.sessions import table as tables
from service.sessions.table import (
    FILE,
    LATE_SECONDS,
    REPEATED_SECONDS,
    SessionRecord,
    SessionTable,
    begun_by,
    session_file,
)

NEW = SessionRecord("s-1", "lab", "2026", '{"lag":2}', 900.0, state=b"fresh")
FRAME = replace(NEW, number=7, moment=3.5, request="robot", lost=0, frames=1, state=b"state", answer="{}")
MOST = 100

_COLUMNS = tables._TABLE.c
_SHIFT = Statement(
    update(tables._TABLE).where(_COLUMNS.id == bindparam("session")).values(used=_COLUMNS.used - bindparam("seconds"))
)


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def ledger(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Ledger]:
    """A ledger with the empty table."""
    if request.param == "postgresql":
        yield request.getfixturevalue("database")
        return
    file = session_file(tmp_path)
    yield file
    file.close()


@pytest.fixture
def table(ledger: Ledger) -> SessionTable:
    return SessionTable(ledger)


def pass_by(ledger: Ledger, session_id: str, seconds: float) -> None:
    """As if the last frame of a session had come so much earlier."""
    assert ledger.change("shift", _SHIFT, session=session_id, seconds=seconds) == 1


def read(table: SessionTable, session_id: str) -> SessionRecord | None:
    """A living session without what the clock gives."""
    found = table.read(session_id)
    return None if found is None else replace(found, created=0.0, used=0.0, idle=0.0)


def test_sessions_are_read_as_they_were_written(table: SessionTable) -> None:
    created, _ = table.add(NEW, MOST)
    assert read(table, "s-1") == NEW and table.read("s-2") is None
    assert table.renew(FRAME) and not table.renew(FRAME), "another frame was saved since revision 0"
    assert read(table, "s-1") == replace(FRAME, revision=1)
    assert table.read("s-1", known=1) is None and table.read("s-1", known=0) is not None
    head = table.head("s-1")
    assert head is not None and (head.number, head.frames, head.state, head.answer) == (7, 1, None, None)
    assert head.created == created <= head.used and 0 <= head.idle < 60
    assert not table.renew(replace(FRAME, id="s-2"))
    table.end("s-1", "over")
    assert not table.renew(replace(FRAME, revision=1)), "a frame that was being processed does not bring it back"
    ended = table.head("s-1")
    assert ended is not None and ended.ended == "over" and table.read("s-1") is None
    table.end("s-1", "over again")
    again = table.head("s-1")
    assert again is not None and (again.ended, again.used) == ("over", ended.used)
    table.forget("s-1")
    assert table.head("s-1") is None and table.living() == []


def test_no_more_live_than_may(ledger: Ledger, table: SessionTable) -> None:
    for number in range(3):
        table.add(replace(NEW, id=f"s-{number}"), most=3)
    with pytest.raises(TooManySessions, match="3 sessions already"):
        table.add(replace(NEW, id="s-3"), most=3)
    assert table.count() == 3 and table.head("s-3") is None
    table.end("s-0", "over")
    table.add(replace(NEW, id="s-3"), most=3)
    pass_by(ledger, "s-1", 901)  # it has expired, though it has not been ended
    table.add(replace(NEW, id="s-4"), most=3)
    assert table.count() == 3 and len(table.living()) == 4


def test_the_caller_with_most_sessions_gives_way(ledger: Ledger, table: SessionTable) -> None:
    def new(name: str, caller: str, map_id: str = "lab") -> SessionRecord:
        return replace(NEW, id=name, map=map_id, begun_by=begun_by(Asker(caller, key=caller)))

    for number in range(4):
        table.add(new(f"s-{number}", "greedy"), most=4)
    pass_by(ledger, "s-2", 60)
    assert [one.id for one in table.add(new("s-4", "robot"), 4, "room")[1]] == ["s-2"], "the longest without a frame"
    assert (ended := table.head("s-2")) is not None and ended.ended == "room"
    assert len(table.add(new("s-5", "robot"), 4, "room")[1]) == 1
    for caller in ("robot", "greedy"):
        with pytest.raises(TooManySessions):
            table.add(new("s-6", caller), most=4)
    pass_by(ledger, "s-4", 60)
    assert [one.id for one in table.add(new("s-6", "robot", "hall"), 4, "room")[1]] == ["s-4"], "of its own other map"
    assert table.count() == 4


def test_sessions_expire_by_the_clock_of_the_database(ledger: Ledger, table: SessionTable) -> None:
    for name, idle in (("s-1", 0), ("s-2", 899), ("s-3", 901), ("s-4", 901 + LATE_SECONDS)):
        table.add(replace(NEW, id=name), MOST)
        pass_by(ledger, name, idle)
    table.add(replace(NEW, id="s-5", map_created_at="2025"), MOST)
    assert [one.id for one in table.living_of("lab", "2026")] == ["s-1", "s-2"]
    assert 899 <= table.living_of("lab", "2026")[1].idle < 960
    assert [one.id for one in table.end_expired("expired")] == ["s-4"]
    assert table.end_expired("expired") == []
    ended = table.head("s-4")
    assert ended is not None and ended.ended == "expired" and ended.idle < 60


def test_ended_sessions_are_forgotten(ledger: Ledger, table: SessionTable) -> None:
    for number in range(3):
        table.add(replace(NEW, id=f"s-{number}"), MOST)
        table.end(f"s-{number}", "over")
    pass_by(ledger, "s-1", tables.REMEMBERED_SECONDS)
    table.add(replace(NEW, id="s-3"), MOST)
    table.end("s-3", "over")
    assert [name for name in ("s-0", "s-1", "s-2", "s-3") if table.head(name)] == ["s-0", "s-2", "s-3"]


def test_a_request_finds_the_session_that_it_began(ledger: Ledger, table: SessionTable) -> None:
    askers = [Asker("robot", key="robot", request_id=f"request {number}") for number in (7, 8)]
    new, other_request = (replace(NEW, begun_by=begun_by(asker)) for asker in askers)
    table.add(new, MOST)
    table.add(replace(NEW, id="s-2"), MOST)
    assert table.begun(new) == "s-1"
    assert table.begun(other_request) is None
    for other in ({"map": "hall"}, {"map_created_at": "2025"}, {"options": "{}"}, {"expires_after": 60.0}):
        assert table.begun(replace(new, **other)) is None
    pass_by(ledger, "s-1", REPEATED_SECONDS)
    assert table.begun(new) is None
    pass_by(ledger, "s-1", -REPEATED_SECONDS)
    assert table.renew(FRAME)
    assert table.begun(new) is None, "a session with a frame is a robot's"


IDS = ("s-1", "s-2", "s-3")
STEPS = st.lists(
    st.tuples(
        st.sampled_from(("add", "renew", "end", "forget")),
        st.sampled_from(IDS),
        st.integers(0, 2**53),
        st.binary(max_size=40),
    ),
    max_size=30,
)


@pytest.mark.thorough
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(STEPS)
def test_any_order_of_writes(table: SessionTable, steps: list[tuple[str, str, int, bytes]]) -> None:
    """A model in plain values stands beside the table; after each step, every session is as the model has it."""
    for name in IDS:
        table.forget(name)
    model: dict[str, SessionRecord] = {}
    for kind, name, number, state in steps:
        known = model.get(name)
        if kind == "add" and known is None:
            model[name] = replace(NEW, id=name, state=state)
            table.add(model[name], MOST)
        elif kind == "renew":
            frame = replace(
                known or replace(NEW, id=name), number=number, moment=number / 7, frames=number, state=state
            )
            lives = known is not None and known.ended is None
            assert table.renew(frame) == lives
            if lives:
                model[name] = replace(frame, revision=frame.revision + 1)
        elif kind == "end" and known is not None:
            table.end(name, "over")
            model[name] = replace(known, ended="over")
        elif kind == "forget":
            table.forget(name)
            model.pop(name, None)
        living = {name: one for name, one in model.items() if one.ended is None}
        assert [one.id for one in table.living()] == sorted(living)
        for each in IDS:
            assert read(table, each) == living.get(each)
            assert (table.head(each) is None) == (each not in model)


def test_what_was_written_is_there_after_a_crash(tmp_path: Path) -> None:
    first = session_file(tmp_path)
    SessionTable(first).add(NEW, MOST)
    second = session_file(tmp_path)  # as after a crash: nothing was closed
    assert read(SessionTable(second), "s-1") == NEW
    first.close()
    second.close()
    with pytest.raises(sqlite3.ProgrammingError):
        SessionTable(first).renew(FRAME)


@pytest.mark.parametrize("damage", ["bytes", "version", "table"])
def test_a_file_that_cannot_be_read_is_put_aside(tmp_path: Path, damage: str) -> None:
    file = session_file(tmp_path)
    SessionTable(file).add(NEW, MOST)
    file.close()
    path = tmp_path / FILE
    if damage == "bytes":
        path.write_bytes(b"not a database at all" * 500)
    else:
        with sqlite3.connect(path) as connection:
            connection.execute("PRAGMA user_version = 99" if damage == "version" else "DROP TABLE sessions")
        connection.close()
    again = session_file(tmp_path)
    table = SessionTable(again)
    assert table.living() == [] and list(tmp_path.glob(f"{FILE}.damaged-*"))
    table.add(NEW, MOST)
    assert read(table, "s-1") == NEW
    again.close()
