"""What a service says is heard by those that share its state, and a service that is gone is not among them."""

from __future__ import annotations

import queue
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import MetaData

from core.ledger import Tables
from core.ledger.sqlite import SqliteLedger, file_of
from service.peers import replica as replicas
from service.peers.alone import Alone
from service.peers.replica import ServiceReplica

if TYPE_CHECKING:
    from service.shared.database import SharedDatabase

EMPTY = Tables("empty", 1, MetaData())


def test_a_service_alone_hears_itself(tmp_path: Path) -> None:
    alone, heard = Alone(), list[str | None]()
    alone.hear("job", heard.append)
    alone.say("job", "j1")
    alone.say("other", "j2")
    assert heard == ["j1"] and alone.living
    ledger = SqliteLedger.open(file_of(tmp_path / "empty.sqlite", EMPTY))
    with ledger.transaction("look") as connection:
        assert alone.living_ids(connection) == [alone.id]
    ledger.close()


@pytest.mark.postgres
def test_services_hear_one_another_until_they_leave(database: SharedDatabase, tmp_path: Path) -> None:
    one, other = (ServiceReplica(database, tmp_path / name) for name in ("one", "other"))
    heard: queue.Queue[tuple[str, str | None]] = queue.Queue()
    for service in (one, other):
        service.hear("job", lambda text, service=service: heard.put((service.id, text)))  # type: ignore[misc]
        service.start()
    listening = [heard.get(timeout=30) for _ in range(2)]
    assert sorted(listening) == sorted([(one.id, None), (other.id, None)])
    one.say("job", "j1")
    one.say("other", "j2")
    assert sorted(heard.get(timeout=30) for _ in range(2)) == sorted([(one.id, "j1"), (other.id, "j1")])

    def living_ids() -> list[str]:
        with database.transaction("look") as connection:
            return one.living_ids(connection)

    assert one.living and living_ids() == sorted([one.id, other.id])
    other.close()
    assert living_ids() == [one.id]
    one.close()
    assert living_ids() == [] and heard.empty()


@pytest.mark.postgres
def test_a_service_that_says_nothing_is_gone(
    database: SharedDatabase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replicas, "GONE_SECONDS", 0.0)
    service = ServiceReplica(database, tmp_path)
    service.beat()
    with database.transaction("look") as connection:
        assert service.living_ids(connection) == []


@pytest.mark.postgres
def test_a_copy_of_a_data_directory_displaces_the_first_one(database: SharedDatabase, tmp_path: Path) -> None:
    first, copy = ServiceReplica(database, tmp_path), ServiceReplica(database, tmp_path)
    first.beat()
    assert first.id == copy.id and first.living
    copy.beat()
    first.beat()
    copy.beat()
    assert copy.living and not first.living and "copy" in first.state
    first.close()  # it takes no leave for the other one
    with database.transaction("look") as connection:
        assert copy.living_ids(connection) == [copy.id]
