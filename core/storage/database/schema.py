"""The tables of ``map.sqlite``."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from typing import TypeVar

from core.disk.files import Damage
from core.disk.sqlite_file import NotOurs, Schema, UnreadVersion, transaction
from core.places import NO_SEQUENCE
from core.storage.database import row_checksums

APPLICATION_ID = 0x504C5243  # "PLRC"

T = TypeVar("T")

LONGEST_INDEXED = 512
"""Most characters of a text in a place's metadata by which the place can be found; longer texts are only stored."""


def _values_of(place: str) -> str:
    """Rows of ``place_values`` for the top-level scalars of a place's metadata."""
    return (
        "SELECT key, CASE type WHEN 'true' THEN 'boolean' WHEN 'false' THEN 'boolean'"
        " WHEN 'integer' THEN 'number' WHEN 'real' THEN 'number' ELSE type END,"
        f" coalesce(atom, 0), {place}.row FROM {{source}}json_each({place}.metadata)"
        f" WHERE type NOT IN ('object', 'array') AND (type <> 'text' OR length(atom) <= {LONGEST_INDEXED})"
    )


_FILL_VALUES = (
    f"INSERT OR IGNORE INTO place_values {_values_of('p').format(source='places p, ')} AND json_valid(p.metadata)"
)
_INSERT_VALUES = f"INSERT OR IGNORE INTO place_values {_values_of('new').format(source='')}"
_DELETE_VALUES = f"DELETE FROM place_values WHERE (key, kind, value, row) IN ({_values_of('old').format(source='')})"

# The column "seal" is the checksum of a row (:mod:`core.storage.database.row_checksums`).
_TABLES = (
    # local_cells and local_values are the shape of the local descriptors; 0 without a second stage.  Which frames are
    # stored for review is JSON; NULL: none.
    """CREATE TABLE map (
        only INTEGER PRIMARY KEY CHECK (only = 1),
        id TEXT NOT NULL,
        encoder TEXT NOT NULL,
        dimension INTEGER NOT NULL CHECK (dimension > 0),
        local_cells INTEGER NOT NULL CHECK (local_cells >= 0),
        local_values INTEGER NOT NULL CHECK (local_values >= 0),
        precision TEXT NOT NULL,
        rows_per_segment INTEGER NOT NULL CHECK (rows_per_segment > 0),
        "index" TEXT NOT NULL,
        description TEXT NOT NULL,
        keep TEXT NOT NULL,
        same_place_radius REAL NOT NULL,
        same_place_frames INTEGER NOT NULL,
        calibration TEXT,
        verification INTEGER NOT NULL CHECK (verification IN (0, 1)),
        review TEXT,
        revision INTEGER NOT NULL,
        created_at TEXT NOT NULL,
        updated_at TEXT NOT NULL,
        seal INTEGER
    ) STRICT""",
    # A code is never used twice, so that an old snapshot cannot confuse two sequences.
    """CREATE TABLE sequences (
        code INTEGER PRIMARY KEY AUTOINCREMENT,
        name TEXT UNIQUE,
        next_ordinal INTEGER NOT NULL
    ) STRICT""",
    f"INSERT INTO sequences VALUES ({NO_SEQUENCE}, NULL, 0)",
    # Of each segment file: how many rows it has, and the checksum of their checksums.  The files of removed segments,
    # which are without a place, are deleted (:mod:`core.storage.removed_segments`).
    """CREATE TABLE segments (
        number INTEGER PRIMARY KEY,
        rows INTEGER NOT NULL CHECK (rows > 0),
        checksum INTEGER NOT NULL,
        removed INTEGER NOT NULL DEFAULT 0
    ) STRICT""",
    # Track and station are the sequence and the ordinal at which another traverse shows what this place shows
    # (:class:`Whereabouts`); NULL: those of the place itself.  That sequence may be gone, whose code is never used
    # again.  pose_of is the id of the place whose pose the place got with its station; NULL: the pose is its own.
    """CREATE TABLE places (
        number INTEGER PRIMARY KEY AUTOINCREMENT,
        id TEXT NOT NULL UNIQUE,
        row INTEGER NOT NULL UNIQUE CHECK (row >= 0),
        checksum INTEGER NOT NULL,
        digest BLOB NOT NULL CHECK (length(digest) = 32),
        regions INTEGER NOT NULL CHECK (regions >= 0),
        picture TEXT NOT NULL CHECK (picture IN ('none', 'thumbnail', 'image')),
        x REAL, y REAL, z REAL, latitude REAL, longitude REAL, heading REAL,
        timestamp TEXT,
        sequence INTEGER NOT NULL REFERENCES sequences (code),
        ordinal INTEGER NOT NULL,
        camera TEXT,
        track INTEGER,
        station INTEGER,
        pose_of TEXT,
        metadata TEXT NOT NULL,
        created_at TEXT NOT NULL,
        updated_at TEXT NOT NULL,
        seal INTEGER
    ) STRICT""",
    "CREATE INDEX places_of_sequence ON places (sequence, number)",
    "CREATE INDEX places_in_order ON places (sequence, ordinal)",
    "CREATE INDEX places_at_station ON places (track, station) WHERE track IS NOT NULL",
    # Apart from the places, so that a listing need not read the pictures.
    """CREATE TABLE pictures (
        place INTEGER PRIMARY KEY REFERENCES places (number) ON DELETE CASCADE,
        digest BLOB NOT NULL CHECK (length(digest) = 32),
        bytes BLOB NOT NULL
    ) STRICT""",
    # Apart from the places, for the same reason.  The checksum covers the digest of the frame, too.
    """CREATE TABLE keypoints (
        place INTEGER PRIMARY KEY REFERENCES places (number) ON DELETE CASCADE,
        checksum INTEGER NOT NULL,
        record BLOB NOT NULL
    ) STRICT""",
    # Which camera took a frame, and what is ignored in its frames.
    """CREATE TABLE cameras (
        name TEXT PRIMARY KEY,
        mask TEXT,
        intrinsics TEXT,
        updated_at TEXT NOT NULL,
        seal INTEGER
    ) STRICT""",
    # The index by which places are found by their metadata.  Triggers update it with every change of a place.  The
    # kind distinguishes true from 1; with the type ANY, 1 and 1.0 are equal.
    """CREATE TABLE place_values (
        key TEXT NOT NULL,
        kind TEXT NOT NULL,
        value ANY NOT NULL,
        row INTEGER NOT NULL,
        PRIMARY KEY (key, kind, value, row)
    ) STRICT, WITHOUT ROWID""",
    f"CREATE TRIGGER place_values_made AFTER INSERT ON places BEGIN {_INSERT_VALUES}; END",
    "CREATE TRIGGER place_values_changed AFTER UPDATE OF row, metadata ON places"
    " WHEN old.row <> new.row OR old.metadata <> new.metadata"
    f" BEGIN {_DELETE_VALUES}; {_INSERT_VALUES}; END",
    f"CREATE TRIGGER place_values_gone AFTER DELETE ON places BEGIN {_DELETE_VALUES}; END",
)

SCHEMA = Schema(APPLICATION_ID, 9, _TABLES)


def _columns(connection: sqlite3.Connection) -> dict[str, set[str]]:
    tables = connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table' AND name NOT LIKE 'sqlite_%'")
    return {
        name: {column for (column,) in connection.execute("SELECT name FROM pragma_table_info(?)", (name,))}
        for (name,) in tables.fetchall()
    }


def prepare(connection: sqlite3.Connection, file: str = "map.sqlite", create: bool = False) -> None:
    """See that a file has the tables of a map.

    Args:
        file: its name in a refusal.
        create: make the tables if the file is empty.

    Raises:
        DataDirectoryTooNew: a later version of placerec wrote the file.
        DataDirectoryTooOld: it was written before the first release.
        Damage: it is not the database of a map, or it has these tables and yet another version.
        sqlite3.Error: a statement failed; the file is as it was.
    """
    row_checksums.register(connection)
    try:
        SCHEMA.prepare(connection, create)
    except NotOurs as error:
        raise Damage("map.sqlite is not one of placerec's databases") from error
    except UnreadVersion as error:
        if _parts(connection) == _expected(_parts):
            claimed = f"map.sqlite says that it is of schema {error.version}"
            raise Damage(f"{claimed}, but its tables are of {SCHEMA.version}") from error
        raise error.refusal(file) from error


def _parts(connection: sqlite3.Connection) -> tuple[set[tuple[str, str]], dict[str, set[str]]]:
    """The tables, indexes and triggers of a file by type and name, and the columns of its tables."""
    query = "SELECT type, name FROM sqlite_schema WHERE name NOT LIKE 'sqlite_%'"
    return set(connection.execute(query)), _columns(connection)


def _expected(read: Callable[[sqlite3.Connection], T]) -> T:
    """The result of ``read`` for a file that has the tables of a map."""
    wanted = sqlite3.connect(":memory:", isolation_level=None)
    try:
        prepare(wanted, create=True)
        return read(wanted)
    finally:
        wanted.close()


def check_schema(connection: sqlite3.Connection) -> None:
    """Check that a file has the tables of a map with their columns.

    Raises:
        Damage: one is missing.
    """
    found = _columns(connection)
    for table, columns in _expected(_columns).items():
        if missing := columns - found.get(table, set()):
            raise Damage(f"map.sqlite lacks {', '.join(sorted(missing))} of its table {table!r}")


def contradictions(connection: sqlite3.Connection, limit: int = 10) -> list[str]:
    """Where the index of metadata and the ends of sequences contradict the places, at most ``limit`` of each kind."""
    return stale_metadata_index(connection, limit) + wrong_sequence_ends(connection, limit)


def stale_metadata_index(connection: sqlite3.Connection, limit: int = 10) -> list[str]:
    """Where the index of metadata does not match the places; :func:`rebuild_metadata_index` repairs it."""
    problems = []
    found, due = "SELECT key, kind, value, row FROM place_values", _values_of("p").format(source="places p, ")
    for first, second in ((found, due), (due, found)):
        query = f"SELECT row, key FROM ({first} EXCEPT {second}) LIMIT {limit}"
        for row, key in connection.execute(query).fetchall():
            problems.append(f"row {row} is not indexed correctly by its metadata {key!r}")
    return problems


def rebuild_metadata_index(connection: sqlite3.Connection) -> None:
    """Rebuild the index of metadata in one transaction.

    Raises:
        sqlite3.Error: the disk refuses; all is as it was.
    """
    with transaction(connection):
        connection.execute("DELETE FROM place_values")
        connection.execute(_FILL_VALUES)


def wrong_sequence_ends(connection: sqlite3.Connection, limit: int = 10) -> list[str]:
    """The sequences whose next place would not come after their last."""
    query = (
        "SELECT s.name FROM sequences s JOIN places p ON p.sequence = s.code WHERE s.name IS NOT NULL GROUP BY s.code"
        f" HAVING s.next_ordinal <= max(p.ordinal) LIMIT {limit}"
    )
    return [f"sequence {name!r} ends before its last place" for (name,) in connection.execute(query).fetchall()]
