"""Deleting entities that no place names: left by a service that died after it gave them to Milvus."""

from __future__ import annotations

import logging

from core.ledger.postgres import PostgresLedger
from core.milvus.collection import MOST_FOUND, Collection
from core.postgres import rows
from core.postgres.sweep import last_key_of_ended_writes

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
        last = last_key_of_ended_writes(database)
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
