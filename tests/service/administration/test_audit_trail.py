"""Where the trail is stored: a file that can be moved away, the latest lines in memory, a table of all services."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from core.errors import StorageFailure
from core.ledger import Ledger
from core.ledger.sqlite import SqliteLedger, file_of
from service.access.audit import Asker, note_change
from service.administration import audit_trail as trails
from service.administration.audit_trail import AuditTable, AuditTrail, audit_trail, detach

EVE = Asker("eve", "0123456789ab", "prune_map", "a-request", None, "10.0.0.1")


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def ledger(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Ledger]:
    """A ledger that has the table, in each of the two databases."""
    if request.param == "postgresql":
        yield request.getfixturevalue("database")
        return
    found = SqliteLedger.open(file_of(tmp_path / "audit.sqlite", trails.TABLES))
    yield found
    found.close()


def note(*map_ids: str) -> None:
    for map_id in map_ids:
        note_change(EVE, {"map": map_id}, {}, 200)


def maps(trail: AuditTrail) -> list[str]:
    """The maps of the lines from the latest to the oldest, which are the same in pages of one line."""
    found = list(trail.lines(None))
    paged, at = [], None
    while (line := next(trail.lines(at), None)) is not None:
        paged.append(line)
        at = line.position
    assert paged == found
    for line in found:
        assert line.fields is not None and line.size > 100
        assert (line.fields["logger"], line.fields["principal"]) == ("placerec.audit", "eve")
    return [(line.fields or {})["map"] for line in found]


def test_a_file_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    with audit_trail(path) as trail:
        note("lab")
        path.rename(tmp_path / "audit.jsonl.1")
        note("yard")
        assert trail.source == "file" and maps(trail) == ["yard", "lab"]
    note("late")
    for name, map_id in (("audit.jsonl.1", "lab"), ("audit.jsonl", "yard")):
        (line,) = (json.loads(text) for text in (tmp_path / name).read_text().splitlines())
        assert (line["logger"], line["map"], line["principal"]) == ("placerec.audit", map_id, "eve")
    with pytest.raises(StorageFailure, match="cannot be opened"), audit_trail(tmp_path / "absent" / "audit.jsonl"):
        pass


def test_the_latest_lines_are_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trails, "RECENT_LINES", 3)
    with audit_trail(None) as trail:
        note("a", "b", "c", "d")
        assert trail.source == "memory" and maps(trail) == ["d", "c", "b"]


def test_a_table_has_the_lines_of_all_services(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trails, "LINES_AT_ONCE", 3)
    for replica, map_ids in (("r-1", "abcd"), ("r-2", "efgh")):
        trail = AuditTable(ledger, replica)
        trail.start()
        note(*map_ids)
        detach(trail)  # which writes the lines that wait
        note("late")
    assert trail.source == "database" and maps(trail) == list("hgfedcba")
    assert [(line.fields or {})["replica"] for line in trail.lines(None)] == ["r-2"] * 4 + ["r-1"] * 4


def test_lines_wait_for_a_database_that_is_away(monkeypatch: pytest.MonkeyPatch) -> None:
    from service.shared.database import SharedDatabase

    monkeypatch.setattr(trails, "MOST_WAITING", 5)
    trail = AuditTable(SharedDatabase("postgresql://placerec@127.0.0.1:9/postgres"), "r-1")
    trails.attach(trail)
    note(*"abcdefgh")
    assert trail.lost == 3, "the oldest ones are in the log alone"
    with pytest.raises(StorageFailure):
        trail._write()
    assert [json.loads(line)["map"] for line in trail._waiting] == list("defgh")
    detach(trail)


def test_old_lines_of_a_table_are_dropped(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trails, "LINES_AT_ONCE", 3)
    trail = AuditTable(ledger, "r-1")
    trail.start()
    note(*"abcdefgh")
    detach(trail)
    last = next(trail.lines(None))
    trail.forget_before(datetime(2020, 1, 1, tzinfo=UTC))
    assert maps(trail) == list("hgfedcba")
    trail.forget_before(datetime.fromisoformat((last.fields or {})["time"]))
    assert maps(trail)[0] == "h"
    trail.forget_before(datetime.now(UTC) + timedelta(days=1))
    assert maps(trail) == []
