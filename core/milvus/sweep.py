"""Deleting entities that no place names: left by a service that died after it gave them to Milvus.

A key is drawn, and its entity inserted, by a write that holds a lock on its map's row until it has ended.  So once that
lock was had of every map, all keys up to the last one drawn before belong to writes that have ended: one of them that
PostgreSQL does not know now will never be known.
"""

from __future__ import annotations

import logging

from core.errors import UnknownMap
from core.ledger.maps import record
from core.ledger.maps.connection import MapConnection
from core.ledger.postgres import PostgresLedger
from core.milvus.collection import MOST_FOUND, Collection
from core.postgres import rows

SWEEPING = 7062
"""The kind of the lock of the database that whoever sweeps holds."""

log = logging.getLogger(__name__)


def sweep(database: PostgresLedger, collections: list[Collection]) -> int:
    """Delete the entities of ended writes that no place names; returns how many.  Others may write meanwhile.

    Nothing is done if somebody else is sweeping.

    Raises:
        StoreUnavailable, StorageFailure.
    """
    with database.locked("sweep", SWEEPING, 0, wait=False) as lock:
        if lock is None:
            return 0
        last = _last_key_of_ended_writes(database)
        count = 0
        for collection in collections:
            for first in range(0, last + 1, MOST_FOUND):
                found = collection.keys_between(first, min(first + MOST_FOUND, last + 1))
                if not found:
                    continue
                with database.reading() as connection:
                    orphans = sorted(set(found) - rows.known_keys(connection, found))
                for start in range(0, len(orphans), rows.ORPHANS_AT_ONCE):
                    collection.delete(orphans[start : start + rows.ORPHANS_AT_ONCE])
                count += len(orphans)
    if count:
        log.warning("%d descriptors of writes that came to no end are deleted from Milvus", count)
    return count


def _last_key_of_ended_writes(database: PostgresLedger) -> int:
    """A key; the writes that have drawn it or an earlier one have ended."""
    with database.reading() as connection:
        last, numbers = rows.last_key(connection), record.numbers(connection)
    for number in numbers:
        try:
            with database.transaction("wait for the writes to a map") as connection:
                record.state_of(MapConnection(connection, number), str(number), locked=True)
        except UnknownMap:
            continue  # with its writes
    return last
