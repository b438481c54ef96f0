"""The statements that read and write a map's places, sequences, pictures, segments and record.

Every function takes a connection of its caller: one that reads, or that of the transaction to which the statements
shall belong.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from core.disk.files import Damage
from core.errors import StorageFailure, UnknownPlace
from core.maps.enrolling import picture_of
from core.maps.place_filter import PlaceFilter
from core.maps.records import Enrolment, History, Keep, MapRecord, SequenceSummary
from core.maps.stored_fields import POSE_VALUES, field_columns, moment_text
from core.places import NO_SEQUENCE, Place, PlaceFields, Pose
from core.storage.database import row_checksums
from core.storage.database.conditions import conditions
from core.storage.database.row_checksums import CHECKED
from core.storage.files.segment_files import Layout

_COLUMNS = CHECKED["places"]
_PLACE = (
    f"SELECT {', '.join(f'p.{name}' for name in _COLUMNS)}, p.seal, s.name"
    " FROM places p JOIN sequences s ON s.code = p.sequence "
)


@dataclass(frozen=True)
class StoredPlace:
    """A place as it is stored.

    number: grows in the order of enrolment.
    row: of its descriptor.
    digest: SHA-256 of its image, 32 bytes.
    sequence: code of its sequence, NO_SEQUENCE without one.
    ordinal: its position in its sequence (``core.maps.views``).
    track, station: code of the sequence whose frames show what it shows, and where in it; None: its own.
    """

    number: int
    row: int
    digest: bytes
    sequence: int
    ordinal: int
    track: int | None
    station: int | None
    place: Place


@dataclass(frozen=True)
class SegmentEntry:
    """The record of a segment file in SQLite.

    number: counted from 0.
    checksum: of the checksums of its rows (:func:`core.storage.files.segment_files.segment_checksum`).
    removed: no row belongs to a place any more, and the file may be missing.
    """

    number: int
    rows: int
    checksum: int
    removed: bool = False


def _stored(values: tuple[Any, ...]) -> StoredPlace:
    *sealed, seal, sequence = values
    columns = dict(zip(_COLUMNS, sealed, strict=True))
    if not row_checksums.is_sound(sealed, seal):
        raise Damage(f"map.sqlite: place {columns['id']!r} does not match its checksum")
    pose = {name: columns[name] for name in POSE_VALUES if columns[name] is not None}
    try:
        place = Place(
            id=columns["id"],
            pose_of=columns["pose_of"],
            regions=columns["regions"],
            picture=columns["picture"],
            pose=Pose(**pose) if pose else None,
            timestamp=columns["timestamp"],
            sequence=sequence,
            camera=columns["camera"],
            metadata=json.loads(columns["metadata"]),
            created_at=columns["created_at"],
            updated_at=columns["updated_at"],
        )
    except ValueError as error:
        raise Damage(f"map.sqlite: place {columns['id']!r} is invalid") from error
    numbers = {name: columns[name] for name in ("number", "row", "digest", "sequence", "ordinal", "track", "station")}
    return StoredPlace(**numbers, place=place)


# Reading


def find(connection: sqlite3.Connection, place_id: str) -> StoredPlace | None:
    """The place of this id; None if there is none."""
    values = connection.execute(_PLACE + "WHERE p.id = ?", (place_id,)).fetchone()
    return None if values is None else _stored(values)


def expect(connection: sqlite3.Connection, place_id: str) -> StoredPlace:
    """The place of this id.

    Raises:
        UnknownPlace: there is none.
    """
    stored = find(connection, place_id)
    if stored is None:
        raise UnknownPlace(f"The map has no place {place_id[:140]!r}.")
    return stored


def places_after(connection: sqlite3.Connection, after: int, limit: int, wanted: PlaceFilter) -> list[StoredPlace]:
    """Up to ``limit`` places that fulfil some conditions, in the order of their enrolment."""
    wanted_by = conditions(wanted)
    also = "".join(f" AND {condition}" for condition in wanted_by)
    query = f"{_PLACE}WHERE p.number > ?{also} ORDER BY p.number LIMIT ?"
    return [_stored(row) for row in connection.execute(query, (after, *wanted_by.values(), limit)).fetchall()]


def ids_of(connection: sqlite3.Connection, wanted: PlaceFilter, limit: int) -> list[str]:
    """The ids of up to ``limit`` places that fulfil some conditions, in the order of their enrolment."""
    wanted_by = conditions(wanted)
    where = f" WHERE {' AND '.join(wanted_by)}" if wanted_by else ""
    query = f"SELECT p.id FROM places p JOIN sequences s ON s.code = p.sequence{where} ORDER BY p.number LIMIT ?"
    return [place_id for (place_id,) in connection.execute(query, (*wanted_by.values(), limit)).fetchall()]


def places_of_rows(connection: sqlite3.Connection, rows: list[int]) -> dict[int, Place]:
    """The places whose descriptors are in ``rows`` now."""
    return {row: stored.place for row, stored in stored_at(connection, rows).items()}


def stored_at(connection: sqlite3.Connection, rows: list[int]) -> dict[int, StoredPlace]:
    """The places whose descriptors are in ``rows`` now, as they are stored."""
    query = _PLACE + "WHERE p.row IN (SELECT value FROM json_each(?))"
    found = (_stored(values) for values in connection.execute(query, (json.dumps(rows),)).fetchall())
    return {stored.row: stored for stored in found}


def rows_of_places(connection: sqlite3.Connection, place_ids: list[str]) -> dict[str, int]:
    """The descriptor rows of places by id; ids that do not exist are left out."""
    query = "SELECT id, row FROM places WHERE id IN (SELECT value FROM json_each(?))"
    return dict(connection.execute(query, (json.dumps(place_ids),)).fetchall())


def sequences_after(connection: sqlite3.Connection, after: str, limit: int) -> list[SequenceSummary]:
    """Up to ``limit`` sequences by name."""
    query = (
        "SELECT s.name, count(*), min(p.timestamp), max(p.timestamp) FROM sequences s"
        " JOIN places p ON p.sequence = s.code WHERE s.name > ? GROUP BY s.name ORDER BY s.name LIMIT ?"
    )
    return [
        SequenceSummary(name=name, places=places, first_at=first, last_at=last)
        for name, places, first, last in connection.execute(query, (after, limit)).fetchall()
    ]


def rows_of_sequence(connection: sqlite3.Connection, name: str) -> list[int]:
    """The descriptor rows of a sequence's places."""
    query = "SELECT p.row FROM places p JOIN sequences s ON s.code = p.sequence WHERE s.name = ?"
    return [row for (row,) in connection.execute(query, (name,)).fetchall()]


def picture(connection: sqlite3.Connection, number: int, place_id: str) -> bytes | None:
    """The stored picture of a place's frame; None if there is none.

    Args:
        number, place_id: of the place.

    Raises:
        StorageFailure: the picture does not match its SHA-256.
    """
    found = connection.execute("SELECT bytes, digest FROM pictures WHERE place = ?", (number,)).fetchone()
    if found is None:
        return None
    content: bytes = found[0]
    if not isinstance(content, bytes) or hashlib.sha256(content).digest() != found[1]:
        raise StorageFailure(f"The stored picture of place {place_id!r} is damaged.")
    return content


# Writing


def _sequence_code(connection: sqlite3.Connection, name: str | None) -> int:
    if name is None:
        return NO_SEQUENCE
    found = connection.execute("SELECT code FROM sequences WHERE name = ?", (name,)).fetchone()
    if found is not None:
        return int(found[0])
    code = connection.execute("INSERT INTO sequences (name, next_ordinal) VALUES (?, 0)", (name,)).lastrowid
    assert code is not None
    return code


def new_track(connection: sqlite3.Connection) -> int:
    """The code of a track whose sequence is gone: no sequence has it or will ever get it."""
    code = connection.execute("INSERT INTO sequences (name, next_ordinal) VALUES (NULL, 0)").lastrowid
    assert code is not None
    connection.execute("DELETE FROM sequences WHERE code = ?", (code,))
    return code


def latest_in_sequence(
    connection: sqlite3.Connection, name: str, positions: int
) -> tuple[tuple[int, int] | None, dict[int, int]]:
    """The end of a sequence: ordinal and row of its last place, and the row of the first place at each last ordinal.

    Args:
        positions: the number of ordinals before the last one that are looked at, too.
    """
    found = connection.execute("SELECT code, next_ordinal FROM sequences WHERE name = ?", (name,)).fetchone()
    if found is None:
        return None, {}
    code, following = found
    last = connection.execute(
        "SELECT ordinal, row FROM places WHERE sequence = ? ORDER BY number DESC LIMIT 1", (code,)
    ).fetchone()
    if last is None:
        return None, {}
    first = {}
    for ordinal in sorted({last[0], *range(max(0, following - 1 - positions), following)}):
        row = first_at(connection, code, ordinal)
        if row is not None:
            first[int(ordinal)] = row
    return (int(last[0]), int(last[1])), first


def first_at(connection: sqlite3.Connection, code: int, ordinal: int, before: int | None = None) -> int | None:
    """The row of the first place at a position of a sequence; None if none is there.

    Args:
        before: only places with a smaller number count; None: all.
    """
    query = "SELECT min(number), row FROM places WHERE sequence = ? AND ordinal = ? AND number < coalesce(?, ?)"
    _, row = connection.execute(query, (code, ordinal, before, 1 << 62)).fetchone()
    return None if row is None else int(row)


def beside(connection: sqlite3.Connection, stored: StoredPlace) -> list[int]:
    """Rows of places at the position of one that gets another picture: see :func:`core.maps.views.leaves_view`."""
    there = "FROM places WHERE sequence = ? AND ordinal = ? AND number"
    at = (stored.sequence, stored.ordinal, stored.number)
    found = [
        connection.execute(f"SELECT max(number), row {there} < ? AND row > ?", (*at, stored.row)).fetchone()[1],
        connection.execute(f"SELECT max(number), row {there} < ?", at).fetchone()[1],
        connection.execute(f"SELECT min(number), row {there} > ?", at).fetchone()[1],
    ]
    return [] if found[0] is None else list({int(row) for row in found if row is not None})


def move(connection: sqlite3.Connection, stored: StoredPlace, ordinal: int | None) -> StoredPlace:
    """Put a place at another position of its sequence, or (None) at its end."""
    at = _next_ordinal(connection, stored.sequence) if ordinal is None else ordinal
    _set(connection, stored.number, ordinal=at)
    return expect(connection, stored.place.id)


def _next_ordinal(connection: sqlite3.Connection, code: int) -> int:
    query = "UPDATE sequences SET next_ordinal = next_ordinal + 1 WHERE code = ? RETURNING next_ordinal - 1"
    ((ordinal,),) = connection.execute(query, (code,)).fetchall()
    return int(ordinal)


def _drop_if_empty(connection: sqlite3.Connection, code: int) -> None:
    query = (
        "DELETE FROM sequences WHERE code = ?1 AND name IS NOT NULL"
        " AND NOT EXISTS (SELECT 1 FROM places WHERE sequence = ?1)"
    )
    connection.execute(query, (code,))


def _put_picture(connection: sqlite3.Connection, number: int, content: bytes | None) -> None:
    """Store the picture of a place that has none."""
    if content is not None:
        digest = hashlib.sha256(content).digest()
        connection.execute("INSERT INTO pictures VALUES (?, ?, ?)", (number, digest, content))


def insert(
    connection: sqlite3.Connection,
    item: Enrolment,
    row: int,
    checksum: int,
    keep: Keep,
    now: datetime,
    ordinal: int | None = None,
) -> StoredPlace:
    """Insert a new place, at a position in its sequence or (None) at its end."""
    code = _sequence_code(connection, item.fields.sequence)
    picture, content = picture_of(item, keep)
    columns = {
        "id": item.id,
        "row": row,
        "checksum": checksum,
        "digest": item.digest,
        "regions": item.regions,
        "picture": picture,
        "sequence": code,
        "ordinal": _next_ordinal(connection, code) if ordinal is None else ordinal,
        "created_at": moment_text(now),
        "updated_at": moment_text(now),
        **field_columns(item.fields),
    }
    names, marks = ", ".join(columns), ", ".join("?" * len(columns))
    cursor = connection.execute(f"INSERT INTO places ({names}) VALUES ({marks})", tuple(columns.values()))
    assert cursor.lastrowid is not None
    _put_picture(connection, cursor.lastrowid, content)
    row_checksums.write_checksums(connection, "places", "number = ?", cursor.lastrowid)
    return expect(connection, item.id)


def _set(connection: sqlite3.Connection, number: int, **columns: Any) -> None:
    assignments = ", ".join(f"{name} = ?" for name in columns)
    connection.execute(f"UPDATE places SET {assignments} WHERE number = ?", (*columns.values(), number))
    row_checksums.write_checksums(connection, "places", "number = ?", number)


def replace_descriptor(
    connection: sqlite3.Connection,
    stored: StoredPlace,
    item: Enrolment,
    row: int,
    checksum: int,
    keep: Keep,
) -> None:
    """Give a place another frame, whose descriptor is in another row."""
    picture, content = picture_of(item, keep)
    connection.execute("DELETE FROM pictures WHERE place = ?", (stored.number,))
    _put_picture(connection, stored.number, content)
    _set(
        connection,
        stored.number,
        row=row,
        checksum=checksum,
        digest=item.digest,
        regions=item.regions,
        picture=picture,
        track=None,
        station=None,
        pose_of=None,
    )


def set_fields(
    connection: sqlite3.Connection, stored: StoredPlace, fields: PlaceFields, now: datetime, ordinal: int | None = None
) -> StoredPlace:
    """Change the fields of a place.  Its position in its sequence changes only with the sequence.

    Args:
        ordinal: its position in another sequence; None: the end.
    """
    columns = field_columns(fields)
    if fields.sequence != stored.place.sequence:
        code = columns["sequence"] = _sequence_code(connection, fields.sequence)
        columns["ordinal"] = _next_ordinal(connection, code) if ordinal is None else ordinal
    if fields.pose != stored.place.pose:
        columns["pose_of"] = None
    _set(connection, stored.number, updated_at=moment_text(now), **columns)
    if "sequence" in columns:
        _drop_if_empty(connection, stored.sequence)
    return expect(connection, stored.place.id)


def set_counterpart(
    connection: sqlite3.Connection,
    stored: StoredPlace,
    station: tuple[int, int] | None,
    pose: Pose | None,
    pose_of: str | None,
    now: datetime,
) -> StoredPlace:
    """Set where another traverse shows what a place shows, and the pose that it got with that.

    Args:
        station: the code of the sequence and the ordinal in it; None: the place's own.
        pose_of: the id of the place whose pose it is; None: the pose is the place's own, or it has none.
    """
    track, at = (None, None) if station is None else station
    columns: dict[str, Any] = {"track": track, "station": at, "pose_of": pose_of}
    if pose != stored.place.pose:
        columns |= {name: getattr(pose, name) if pose else None for name in POSE_VALUES}
        columns["updated_at"] = moment_text(now)
    _set(connection, stored.number, **columns)
    return expect(connection, stored.place.id)


def set_history(connection: sqlite3.Connection, place_id: str, history: History) -> StoredPlace:
    """Set when a place was made and changed, and its position in its sequence, as in the map that it comes from."""
    stored = expect(connection, place_id)
    moments = {"created_at": moment_text(history.created_at), "updated_at": moment_text(history.updated_at)}
    ordinal = stored.ordinal if history.ordinal is None else history.ordinal
    _set(connection, stored.number, ordinal=ordinal, **moments)
    connection.execute(
        "UPDATE sequences SET next_ordinal = max(next_ordinal, ?) WHERE code = ?",
        (max(ordinal + 1, history.behind), stored.sequence),
    )
    return expect(connection, place_id)


def delete(connection: sqlite3.Connection, stored: StoredPlace) -> None:
    """Delete a place and its picture."""
    connection.execute("DELETE FROM places WHERE number = ?", (stored.number,))
    _drop_if_empty(connection, stored.sequence)


def delete_sequence(connection: sqlite3.Connection, name: str) -> None:
    """Delete a sequence and its places."""
    (code,) = connection.execute("SELECT code FROM sequences WHERE name = ?", (name,)).fetchone()
    connection.execute("DELETE FROM places WHERE sequence = ?", (code,))
    _drop_if_empty(connection, int(code))


# Segment files


def segment_entries(connection: sqlite3.Connection, layout: Layout) -> list[SegmentEntry]:
    """The segments in their order.

    Raises:
        Damage: a segment is missing, or one before the last is not full.
    """
    query = "SELECT number, rows, checksum, removed FROM segments ORDER BY number"
    rows = connection.execute(query).fetchall()
    found = [SegmentEntry(number, count, checksum, bool(removed)) for number, count, checksum, removed in rows]
    for position, segment in enumerate(found):
        if not all(isinstance(value, int) for value in (segment.number, segment.rows, segment.checksum)):
            raise Damage(f"map.sqlite: its entry of segment {position + 1} is invalid")
        full, last = segment.rows == layout.rows_per_segment, position == len(found) - 1
        if segment.number != position or segment.rows > layout.rows_per_segment or not (full or last):
            raise Damage(f"map.sqlite: segment {position + 1} is not as long as it must be")
    return found


def put_segment_entry(connection: sqlite3.Connection, segment: int, rows: int, checksum: int) -> None:
    """Record that a segment file holds ``rows`` rows, and the checksum of their checksums."""
    statement = "INSERT OR REPLACE INTO segments (number, rows, checksum) VALUES (?, ?, ?)"
    connection.execute(statement, (segment, rows, checksum))


# The map's own record


def insert_record(connection: sqlite3.Connection, record: MapRecord, rows_per_segment: int) -> None:
    """Insert the record of a new map."""
    columns = {"only": 1, "rows_per_segment": rows_per_segment, **_record_columns(record)}
    names, marks = ", ".join(f'"{name}"' for name in columns), ", ".join("?" * len(columns))
    connection.execute(f"INSERT INTO map ({names}) VALUES ({marks})", tuple(columns.values()))
    row_checksums.write_checksums(connection, "map")


def update_record(connection: sqlite3.Connection, record: MapRecord) -> None:
    """Replace the map's record."""
    columns = _record_columns(record)
    assignments = ", ".join(f'"{name}" = ?' for name in columns)
    connection.execute(f"UPDATE map SET {assignments}", tuple(columns.values()))
    row_checksums.write_checksums(connection, "map")


def _record_columns(record: MapRecord) -> dict[str, Any]:
    columns = record.model_dump(exclude={"calibration", "review"})
    columns["calibration"] = None if record.calibration is None else record.calibration.model_dump_json()
    columns["review"] = None if record.review is None else record.review.model_dump_json()
    columns["created_at"] = moment_text(record.created_at)
    columns["updated_at"] = moment_text(record.updated_at)
    return columns


def read_record(connection: sqlite3.Connection) -> tuple[MapRecord, int]:
    """The map's record, and how many rows a full segment has.

    Raises:
        ValueError: the record is missing or invalid.
    """
    cursor = connection.execute("SELECT * FROM map")
    values = cursor.fetchone()
    if values is None:
        raise ValueError("the map's own record is missing")
    columns = {description[0]: value for description, value in zip(cursor.description, values, strict=True)}
    if not row_checksums.is_sound([columns[name] for name in CHECKED["map"]], columns.pop("seal")):
        raise ValueError("it does not match its checksum")
    rows_per_segment = columns.pop("rows_per_segment")
    if not isinstance(rows_per_segment, int):
        raise ValueError("it does not say how many rows a segment has")
    del columns["only"]
    columns["verification"] = bool(columns["verification"])
    for name in ("calibration", "review"):
        if columns[name] is not None:
            columns[name] = json.loads(columns[name])
    return MapRecord.model_validate(columns), rows_per_segment
