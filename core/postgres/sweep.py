"""Deleting objects that no row names, and maps that nobody goes on making.

A key is drawn, and its object written, by a write that holds a lock on its map's row until it has ended.  So once that
lock was had of every map, all keys up to the last one drawn before belong to writes that have ended: one of them that
PostgreSQL does not know now will never be known.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from core.errors import UnknownMap
from core.ledger.maps import record
from core.ledger.maps.connection import MapConnection
from core.ledger.postgres import PostgresLedger
from core.postgres import rows
from core.postgres.pictures.stored import before_key, key_of

if TYPE_CHECKING:
    from core.postgres.pictures.objects import Objects

SWEEPING_OBJECTS = 7064
"""The kind of the lock of the database that whoever deletes objects holds."""

LISTED_SECONDS = 24 * 3600
"""Time between two full listings of the objects: a write whose service was thought dead may leave one."""

log = logging.getLogger(__name__)


def sweep_objects(database: PostgresLedger, objects: Objects) -> int:
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
        last = last_key_of_ended_writes(database)
        with database.reading() as connection:
            folder, first = rows.objects_folder(connection), rows.swept_objects(connection, LISTED_SECONDS)
        count = 0
        for names in objects.names_after(folder, before_key(folder, first)):
            ended = [name for name in names if key_of(name) <= last]
            with database.reading() as connection:
                orphans = sorted(set(ended) - rows.known_objects(connection, ended))
            objects.delete(orphans)
            count += len(orphans)
            if len(ended) < len(names):
                break
        with database.transaction("note what is swept") as connection:
            rows.note_swept_objects(connection, last, whole=not first)
    if count:
        log.warning("%d pictures of writes that came to no end are deleted from the object store", count)
    return dead + count


def _delete_dead_objects(database: PostgresLedger, objects: Objects) -> int:
    count = 0
    while True:
        with database.transaction("delete objects") as connection:
            names = rows.dead_objects(connection)
            objects.delete(names)
            rows.clear_objects(connection, names)
        if not names:
            return count
        count += len(names)


def last_key_of_ended_writes(database: PostgresLedger) -> int:
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
