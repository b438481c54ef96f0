"""Deleting from Milvus what no place names: what a service left that died between the insertion and the COMMIT.

A key is drawn, and its entity inserted, by a write that holds a lock on its map's row until it has ended.  So once that
lock was had of every map, all keys up to the last one drawn before belong to writes that have ended: one of them that
PostgreSQL does not know now will never be known.
"""

from __future__ import annotations

import logging

from core.errors import UnknownMap
from core.milvus import ledger
from core.milvus.collection import MOST_FOUND, Collection
from core.milvus.database import Database

SWEEPING = 7062
"""The kind of the lock of the database that whoever sweeps holds."""

log = logging.getLogger(__name__)


def sweep(database: Database, collections: list[Collection]) -> int:
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
                    orphans = sorted(set(found) - ledger.known_keys(connection, found))
                for start in range(0, len(orphans), ledger.LEAVINGS_AT_ONCE):
                    collection.delete(orphans[start : start + ledger.LEAVINGS_AT_ONCE])
                count += len(orphans)
    if count:
        log.warning("%d descriptors of writes that came to no end are deleted from Milvus", count)
    return count


def _last_key_of_ended_writes(database: Database) -> int:
    with database.reading() as connection:
        last, numbers = ledger.last_key(connection), ledger.map_numbers(connection)
    for number in numbers:
        try:
            with database.transaction("wait for the writes to a map") as connection:
                ledger.state_of(connection, str(number), number, locked=True)
        except UnknownMap:
            continue  # with its writes
    return last
