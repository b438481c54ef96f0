"""Deleting orphans, which no place names: left by a service that died after it gave them to Milvus or the object store.

A key is drawn, and its entity inserted or its object written, by a write that holds a lock on its map's row until it
has ended.  So once that lock was had of every map, all keys up to the last one drawn before belong to writes that have
ended: one of them that PostgreSQL does not know now will never be known.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from core.errors import UnknownMap
from core.milvus import ledger
from core.milvus.collection import MOST_FOUND, Collection
from core.milvus.database import Database
from core.milvus.pictures.stored import before_key, key_of

if TYPE_CHECKING:
    from core.milvus.pictures.objects import Objects

SWEEPING = 7062
"""The kind of the lock of the database that whoever sweeps holds."""

SWEEPING_OBJECTS = 7064
"""The same for objects."""

LISTED_SECONDS = 24 * 3600
"""Time between two full listings of the objects: a write whose service was thought dead may leave one."""

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
                for start in range(0, len(orphans), ledger.ORPHANS_AT_ONCE):
                    collection.delete(orphans[start : start + ledger.ORPHANS_AT_ONCE])
                count += len(orphans)
    if count:
        log.warning("%d descriptors of writes that came to no end are deleted from Milvus", count)
    return count


def sweep_objects(database: Database, objects: Objects) -> int:
    """Delete the objects whose rows are deleted, and those of ended writes that no row names; returns how many.

    Nothing is done if somebody else is doing it.  Objects of rows wait until no map is being exported.  Once a day all
    objects are listed, and else those that came since the last time.

    Raises:
        StoreUnavailable, StorageFailure.
    """
    with database.locked("sweep", SWEEPING_OBJECTS, 0, wait=False) as lock:
        if lock is None:
            return 0
        dead = _delete_dead_objects(database, objects)
        last = _last_key_of_ended_writes(database)
        with database.reading() as connection:
            folder, first = ledger.objects_folder(connection), ledger.swept_objects(connection, LISTED_SECONDS)
        count = 0
        for names in objects.names_after(folder, before_key(folder, first)):
            ended = [name for name in names if key_of(name) <= last]
            with database.reading() as connection:
                orphans = sorted(set(ended) - ledger.known_objects(connection, ended))
            objects.delete(orphans)
            count += len(orphans)
            if len(ended) < len(names):
                break
        with database.transaction("note what is swept") as connection:
            ledger.note_swept_objects(connection, last, whole=not first)
    if count:
        log.warning("%d pictures of writes that came to no end are deleted from the object store", count)
    return dead + count


def _delete_dead_objects(database: Database, objects: Objects) -> int:
    count = 0
    while True:
        with database.transaction("delete objects") as connection:
            names = ledger.dead_objects(connection)
            objects.delete(names)
            ledger.clear_objects(connection, names)
        if not names:
            return count
        count += len(names)


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
