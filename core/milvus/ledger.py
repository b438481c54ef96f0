"""The statements that read and write maps in PostgreSQL.

Every function takes a connection of its caller, within the transaction to which the statements shall belong.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
from psycopg import Connection

from core.errors import MapExists, UnknownMap
from core.maps.counterparts import PlaceStation
from core.maps.place_filter import PlaceFilter
from core.maps.records import MapRecord, Outline, PicturedPlace, SequenceSummary
from core.milvus.pictures.stored import StoredObject, StoredPicture
from core.milvus.tokens import tokens_of
from core.places import GEOGRAPHIC, METRIC, NO_POSE, NO_SEQUENCE, NO_TIME, Place, Whereabouts, microseconds

TABLES = (Path(__file__).parent / "tables.sql").read_text()

VERSION = 2
"""Of the tables; it grows when a placerec that knows only the former ones could not use them."""

WAIT_SECONDS = 10
"""A write that waits for others to the same map is refused after this time."""

WRITING = 7061
"""The kind of the locks of the database by which writes to a map are paused; their number is that of the map."""

EXPORTING = 7063
"""The kind of the lock of the database that exports share, and that who deletes objects has alone."""

LEFT_SECONDS = 60
"""Orphans, which no place names any more, are deleted after this time; queries that need them have ended by then."""

ORPHANS_AT_ONCE = 1000


@dataclass(frozen=True)
class MapState:
    """The state of a map in PostgreSQL, without its places.

    number: never used for another map, also of the same id.
    places, rows: how many places there are; all their rows are below ``rows``.
    writes: grows with every write.
    inserted: the timestamp from which on Milvus sees all descriptors that count.
    collection: Milvus's id of the collection that has them; 0 as long as there are none.
    """

    number: int
    record: MapRecord
    places: int
    rows: int
    writes: int
    inserted: int
    collection: int


@dataclass(frozen=True)
class PlaceEntry:
    """A place as it is stored.

    number: grows in the order of enrolment.
    row: of its frame.
    key: of its entity in Milvus.
    digest: SHA-256 of its image, 32 bytes.
    sequence: code of its sequence, NO_SEQUENCE without one.
    ordinal: its position in its sequence (``core.maps.views``).
    track, station: code of the sequence whose frames show what it shows, and where in it; None: its own.
    """

    number: int
    row: int
    key: int
    digest: bytes
    sequence: int
    ordinal: int
    place: Place
    track: int | None = None
    station: int | None = None

    def whereabouts(self) -> Whereabouts:
        """Where and when its frame was taken."""
        return whereabouts_of([self])

    def outline(self) -> Outline:
        """The place in brief."""
        place = self.place
        return Outline(
            self.number, place.id, self.row, self.digest, place.picture, place.camera, place.sequence, self.ordinal,
            place.updated_at.isoformat(timespec="microseconds"),
        )  # fmt: skip


@dataclass(frozen=True)
class Frame:
    """The stored data of a frame beside its place: descriptor float16 [D], local descriptors int8 [C, L], in bytes."""

    descriptor: bytes
    local: bytes
    keypoints: bytes | None
    picture: StoredPicture


def whereabouts_of(entries: Sequence[PlaceEntry]) -> Whereabouts:
    """Where and when the frames of places were taken."""
    poses = [entry.place.pose for entry in entries]
    moments = [entry.place.timestamp for entry in entries]
    return Whereabouts(
        np.array(
            [NO_POSE if pose is None else METRIC if pose.kind() == "metric" else GEOGRAPHIC for pose in poses], np.int8
        ),
        np.array([np.zeros(3) if pose is None else pose.position() for pose in poses]).reshape(-1, 3),
        np.array([entry.sequence for entry in entries], np.int32),
        np.array([entry.ordinal for entry in entries], np.int64),
        np.array([nan if pose is None or pose.heading is None else pose.heading for pose in poses], np.float32),
        np.array([NO_TIME if moment is None else microseconds(moment) for moment in moments], np.int64),
        np.array([entry.sequence if entry.track is None else entry.track for entry in entries], np.int32),
        np.array([entry.ordinal if entry.station is None else entry.station for entry in entries], np.int64),
    )


# Maps


def version_of(connection: Connection[Any]) -> int | None:
    """The version of the tables; None if there are none."""
    if connection.execute("SELECT to_regclass('placerec')").fetchone() == (None,):
        return None
    found = connection.execute("SELECT version FROM placerec").fetchone()
    return None if found is None else int(found[0])


def create(connection: Connection[Any], record: MapRecord, name: str | None = None, listed: bool = True) -> int:
    """Insert a map without places; returns its number.

    Args:
        name: the id that it has until it is published; None: its own.

    Raises:
        MapExists: the id is taken.
    """
    query = "INSERT INTO maps (id, record, listed) VALUES (%s, %s, %s) ON CONFLICT DO NOTHING RETURNING number"
    made = connection.execute(query, (name or record.id, record.model_dump_json(), listed)).fetchone()
    if made is None:
        (taken,) = connection.execute("SELECT listed FROM maps WHERE id = %s", (record.id,)).fetchone() or (True,)
        raise MapExists(f"There is already a map {record.id!r}." if taken else f"A map {record.id!r} is being made.")
    connection.execute("INSERT INTO sequences (map, code) VALUES (%s, %s)", (made[0], NO_SEQUENCE))
    return int(made[0])


def publish(connection: Connection[Any], number: int, map_id: str) -> None:
    """List a map that was being built, under its id.

    Raises:
        UnknownMap: it is gone, or listed already.
        MapExists: the id is taken.
    """
    try:
        done = connection.execute(
            "UPDATE maps SET id = %s, listed = true WHERE number = %s AND NOT listed", (map_id, number)
        )
    except psycopg.errors.UniqueViolation:
        raise MapExists(f"There is already a map {map_id!r}.") from None
    if not done.rowcount:
        raise UnknownMap(f"No map {map_id[:80]!r} is being made.")


def is_taken(connection: Connection[Any], map_id: str) -> bool:
    """Whether a map has this id, or is being built to have it."""
    return connection.execute("SELECT 1 FROM maps WHERE id = %s", (map_id,)).fetchone() is not None


def unlisted(connection: Connection[Any], untouched_seconds: float = 0) -> dict[str, int]:
    """The numbers of the maps that are being built, by the ids that they have meanwhile.

    Args:
        untouched_seconds: only those without a write for this time.
    """
    query = "SELECT id, number FROM maps WHERE NOT listed AND touched <= now() - make_interval(secs => %s)"
    return dict(connection.execute(query, (untouched_seconds,)).fetchall())


def state_of(connection: Connection[Any], map_id: str, number: int | None = None, locked: bool = False) -> MapState:
    """A map.

    Args:
        number: of the map that is meant; None: whichever has the id now.
        locked: whether to keep others from writing to it until the transaction ends.

    Raises:
        UnknownMap: there is none.
    """
    query = "SELECT number, record, places, rows, writes, inserted, collection FROM maps WHERE "
    query += "id = %s AND listed" if number is None else "number = %s"
    key = map_id if number is None else number
    found = connection.execute(query + (" FOR UPDATE" if locked else ""), (key,)).fetchone()
    if found is None:
        raise UnknownMap(f"There is no map {map_id[:80]!r}.")
    return MapState(found[0], MapRecord.model_validate_json(found[1]), *found[2:])


def expect_unpaused(connection: Connection[Any], map_number: int) -> None:
    """Wait until nobody pauses the writes to a map, and keep others from pausing them until the transaction ends."""
    connection.execute(f"SET LOCAL lock_timeout TO '{WAIT_SECONDS}s'")
    connection.execute("SELECT pg_advisory_xact_lock_shared(%s::int, %s::int)", (WRITING, map_number % 2**31))


def records_after(connection: Connection[Any], after: str, limit: int) -> list[MapRecord]:
    """Up to ``limit`` records by id."""
    query = "SELECT record FROM maps WHERE id > %s AND listed ORDER BY id LIMIT %s"
    return [MapRecord.model_validate_json(text) for (text,) in connection.execute(query, (after, limit))]


def delete(connection: Connection[Any], map_id: str, number: int | None = None) -> list[int]:
    """Delete a map and all that belongs to it; returns the keys of its entities in Milvus.

    Args:
        number: of the map that is meant, which may be unlisted; None: the one that has the id.

    Raises:
        UnknownMap: there is none.
    """
    state = state_of(connection, map_id, number, locked=True)
    query = "SELECT key FROM places WHERE map = %s UNION SELECT key FROM leavings WHERE map = %s"
    keys = [key for (key,) in connection.execute(query, (state.number, state.number))]
    connection.execute("DELETE FROM maps WHERE number = %s", (state.number,))
    return keys


def update(connection: Connection[Any], state: MapState) -> None:
    """Store the changes by a write of the map itself."""
    query = (
        "UPDATE maps SET record = %s, places = %s, rows = %s, writes = %s, inserted = %s, collection = %s,"
        " touched = now() WHERE number = %s"
    )
    values = state.record.model_dump_json(), state.places, state.rows, state.writes, state.inserted, state.collection
    connection.execute(query, (*values, state.number))


def used_collections(connection: Connection[Any]) -> dict[int, list[str]]:
    """The ids in Milvus of the collections that have descriptors of maps, and these maps."""
    query = "SELECT collection, array_agg(id ORDER BY id) FROM maps WHERE collection <> 0 GROUP BY collection"
    return dict(connection.execute(query).fetchall())


# Places

_ENTRY = "SELECT number, row, key, digest, sequence, ordinal, place, track, station FROM places WHERE map = %s"


def entry_of(values: tuple[Any, ...]) -> PlaceEntry:
    """A place from its columns, in the order of the statement above."""
    number, row, key, digest, sequence, ordinal, text, track, station = values
    place = Place.model_validate(json.loads(text))
    return PlaceEntry(number, row, key, digest, sequence, ordinal, place, track, station)


def is_storable(value: object) -> bool:
    """Whether PostgreSQL could have a value; it has no text with a zero character or half a surrogate pair."""
    return not isinstance(value, str) or not any(letter == "\0" or "\ud800" <= letter <= "\udfff" for letter in value)


def find(connection: Connection[Any], map_number: int, place_id: str) -> PlaceEntry | None:
    """The place of this id; None if there is none."""
    found = entries_by(connection, map_number, "id", [place_id])
    return found[0] if found else None


def entries_by(connection: Connection[Any], map_number: int, column: str, values: Sequence[Any]) -> list[PlaceEntry]:
    """The places with one of some values in a column, ``id``, ``row`` or ``key``, in any order."""
    query, wanted = f"{_ENTRY} AND {column} = ANY(%s)", [one for one in values if is_storable(one)]
    return [entry_of(found) for found in connection.execute(query, (map_number, wanted))]


def entries_after(
    connection: Connection[Any], map_number: int, after: int, limit: int | None, wanted: PlaceFilter
) -> list[PlaceEntry]:
    """Up to ``limit`` places that fulfil some conditions, in the order of their enrolment; None: all."""
    of_sequence = "sequence = (SELECT s.code FROM sequences s WHERE s.map = places.map AND s.name = %s)"
    given: dict[str, Any] = {
        "number > %s": after,
        "id = ANY(%s)": None if wanted.ids is None else list(wanted.ids),
        of_sequence: wanted.sequence,
        "camera = %s": wanted.camera,
        "moment >= %s": None if wanted.after is None else microseconds(wanted.after),
        "moment <= %s": None if wanted.before is None else microseconds(wanted.before),
        "tokens @> %s::text[]": tokens_of(wanted.metadata) if wanted.metadata else None,
    }
    conditions = {condition: value for condition, value in given.items() if value is not None}
    if not all(map(is_storable, [wanted.sequence or "", wanted.camera or "", *(wanted.ids or ())])):
        return []
    also = "".join(f" AND {condition}" for condition in conditions)
    query = f"{_ENTRY}{also} ORDER BY number LIMIT %s"
    return [entry_of(found) for found in connection.execute(query, (map_number, *conditions.values(), limit))]


def put(connection: Connection[Any], map_number: int, entry: PlaceEntry) -> None:
    """Store a place, in the place of one stored under its number."""
    place = entry.place
    columns = {
        "map": map_number, "number": entry.number, "id": place.id, "row": entry.row, "key": entry.key,
        "digest": entry.digest, "picture": place.picture, "place": json.dumps(place.model_dump(mode="json")),
        "sequence": entry.sequence,
        "ordinal": entry.ordinal, "camera": place.camera,
        "moment": None if place.timestamp is None else microseconds(place.timestamp),
        "tokens": tokens_of(place.metadata), "track": entry.track, "station": entry.station, "pose_of": place.pose_of,
    }  # fmt: skip
    names, marks = ", ".join(columns), ", ".join(["%s"] * len(columns))
    again = ", ".join(f"{name} = excluded.{name}" for name in columns if name not in ("map", "number", "id"))
    query = f"INSERT INTO places ({names}) VALUES ({marks}) ON CONFLICT (map, number) DO UPDATE SET {again}"
    connection.execute(query, tuple(columns.values()))


def remove(connection: Connection[Any], map_number: int, entry: PlaceEntry) -> None:
    """Remove a place; its data is left for a while."""
    connection.execute("DELETE FROM places WHERE map = %s AND number = %s", (map_number, entry.number))


def new_key(connection: Connection[Any]) -> int:
    """A number that was never used before."""
    ((key,),) = connection.execute("SELECT nextval('keys')").fetchall()
    return int(key)


# Sequences


def sequence_codes(connection: Connection[Any], map_number: int, names: Sequence[str]) -> dict[str, int]:
    """The codes of sequences by name; names that do not exist are left out."""
    query = "SELECT name, code FROM sequences WHERE map = %s AND name = ANY(%s)"
    return dict(connection.execute(query, (map_number, [name for name in names if is_storable(name)])).fetchall())


def new_sequence(connection: Connection[Any], map_number: int, name: str) -> int:
    """Make a sequence without places; returns its code."""
    code = new_code(connection, map_number)
    connection.execute("INSERT INTO sequences (map, code, name) VALUES (%s, %s, %s)", (map_number, code, name))
    return code


def wrong_sequence(connection: Connection[Any], map_number: int) -> tuple[str | None] | None:
    """The name of a sequence that has no places, or some behind its end; None if there is none such."""
    query = (
        "SELECT s.name FROM sequences s LEFT JOIN places p ON p.map = s.map AND p.sequence = s.code WHERE s.map = %s"
        " GROUP BY s.map, s.code HAVING coalesce(max(p.ordinal), -1) >= s.next_ordinal"
        " OR (s.name IS NOT NULL AND count(p.number) = 0) LIMIT 1"
    )
    found: tuple[str | None] | None = connection.execute(query, (map_number,)).fetchone()
    return found


def new_code(connection: Connection[Any], map_number: int) -> int:
    """A code that no sequence of a map has or had."""
    query = "UPDATE maps SET codes = codes + 1 WHERE number = %s RETURNING codes - 1"
    ((code,),) = connection.execute(query, (map_number,)).fetchall()
    return int(code)


def put_ordinal(connection: Connection[Any], map_number: int, code: int, ordinal: int) -> None:
    """Have the next place of a sequence stand behind an ordinal."""
    query = "UPDATE sequences SET next_ordinal = greatest(next_ordinal, %s) WHERE map = %s AND code = %s"
    connection.execute(query, (ordinal + 1, map_number, code))


def sequence_ends(connection: Connection[Any], map_number: int) -> dict[str | None, int]:
    """The ordinal that the next place of each sequence gets, by name; None: of the places without a sequence."""
    query = "SELECT name, next_ordinal FROM sequences WHERE map = %s ORDER BY name NULLS FIRST"
    return dict(connection.execute(query, (map_number,)).fetchall())


def sequences_after(connection: Connection[Any], map_number: int, after: str, limit: int) -> list[SequenceSummary]:
    """Up to ``limit`` sequences by name."""
    query = (
        "SELECT s.name, count(*), min(p.moment), max(p.moment) FROM sequences s"
        " JOIN places p ON p.map = s.map AND p.sequence = s.code WHERE s.map = %s AND s.name > %s"
        " GROUP BY s.name ORDER BY s.name LIMIT %s"
    )
    return [
        SequenceSummary(name=name, places=places, first_at=_moment(first), last_at=_moment(last))
        for name, places, first, last in connection.execute(query, (map_number, after, limit))
    ]


def _moment(microseconds_since_1970: int | None) -> datetime | None:
    if microseconds_since_1970 is None:
        return None
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=microseconds_since_1970)


def latest_in_sequence(
    connection: Connection[Any], map_number: int, name: str, positions: int
) -> tuple[tuple[int, int] | None, dict[int, int]]:
    """The end of a sequence: ordinal and row of its last place, and the row of the first place at each last ordinal.

    Args:
        positions: the number of ordinals before the last one that are looked at, too.
    """
    query = "SELECT code, next_ordinal FROM sequences WHERE map = %s AND name = %s"
    found = connection.execute(query, (map_number, name)).fetchone()
    if found is None:
        return None, {}
    code, following = found
    query = "SELECT ordinal, row FROM places WHERE map = %s AND sequence = %s ORDER BY number DESC LIMIT 1"
    last = connection.execute(query, (map_number, code)).fetchone()
    if last is None:
        return None, {}
    first = {}
    for ordinal in sorted({last[0], *range(max(0, following - 1 - positions), following)}):
        row = first_at(connection, map_number, code, ordinal)
        if row is not None:
            first[int(ordinal)] = row
    return (int(last[0]), int(last[1])), first


def first_at(
    connection: Connection[Any], map_number: int, code: int, ordinal: int, before: int | None = None
) -> int | None:
    """The row of the first place at a position of a sequence; None if none is there.

    Args:
        before: only places with a smaller number count; None: all.
    """
    query = (
        "SELECT row FROM places WHERE map = %s AND sequence = %s AND ordinal = %s AND number < %s"
        " ORDER BY number LIMIT 1"
    )
    found = connection.execute(query, (map_number, code, ordinal, 1 << 62 if before is None else before)).fetchone()
    return None if found is None else int(found[0])


def beside(connection: Connection[Any], map_number: int, entry: PlaceEntry) -> list[int]:
    """Rows of places at the position of one that gets another picture: see :func:`core.maps.views.leaves_view`."""
    there = "SELECT row FROM places WHERE map = %s AND sequence = %s AND ordinal = %s AND number"
    at = (map_number, entry.sequence, entry.ordinal, entry.number)
    found = [
        connection.execute(f"{there} < %s AND row > %s ORDER BY number DESC LIMIT 1", (*at, entry.row)).fetchone(),
        connection.execute(f"{there} < %s ORDER BY number DESC LIMIT 1", at).fetchone(),
        connection.execute(f"{there} > %s ORDER BY number LIMIT 1", at).fetchone(),
    ]
    return [] if found[0] is None else list({int(row[0]) for row in found if row is not None})


def next_in_sequence(
    connection: Connection[Any], map_number: int, name: str | None, ordinal: int | None = None
) -> tuple[int, int]:
    """The code of a sequence, which is made if there is none, and the ordinal of its next place.

    Args:
        ordinal: of a place that shows a view which is there already; None: of one at the end.
    """
    code = NO_SEQUENCE if name is None else sequence_codes(connection, map_number, [name]).get(name)
    if name is not None and code is None:
        code = new_sequence(connection, map_number, name)
    if ordinal is not None and code is not None:
        return code, ordinal
    query = (
        "UPDATE sequences SET next_ordinal = next_ordinal + 1 WHERE map = %s AND code = %s RETURNING next_ordinal - 1"
    )
    ((ordinal,),) = connection.execute(query, (map_number, code)).fetchall()
    return NO_SEQUENCE if code is None else code, int(ordinal)


def drop_if_empty(connection: Connection[Any], map_number: int, code: int) -> None:
    """Remove a sequence without places; its code is never used again."""
    query = (
        "DELETE FROM sequences WHERE map = %s AND code = %s AND name IS NOT NULL"
        " AND NOT EXISTS (SELECT 1 FROM places p WHERE p.map = sequences.map AND p.sequence = sequences.code)"
    )
    connection.execute(query, (map_number, code))


def place_stations(connection: Connection[Any], map_number: int) -> dict[str, PlaceStation]:
    """Where all places are along their sequences and tracks, by id, in the order of their enrolment."""
    query = "SELECT id, digest, sequence, ordinal, track, station, pose_of FROM places WHERE map = %s ORDER BY number"
    return {values[0]: PlaceStation(*values) for values in connection.execute(query, (map_number,))}


def handed_over(connection: Connection[Any], map_number: int) -> dict[int, str]:
    """The rows of the places whose pose was handed over, each with the id of the place that it comes from."""
    query = "SELECT row, pose_of FROM places WHERE map = %s AND pose_of IS NOT NULL"
    return dict(connection.execute(query, (map_number,)).fetchall())


def oldest_of_last(connection: Connection[Any], map_number: int, code: int, frames: int) -> int | None:
    """The smallest ordinal among the ``frames`` places of a sequence enrolled last; None: it has no places."""
    query = (
        "SELECT min(ordinal) FROM (SELECT ordinal FROM places WHERE map = %s AND sequence = %s"
        " ORDER BY number DESC LIMIT %s) AS last"
    )
    ((ordinal,),) = connection.execute(query, (map_number, code, frames)).fetchall()
    return None if ordinal is None else int(ordinal)


# Frames


def put_frame(connection: Connection[Any], map_number: int, row: int, frame: Frame) -> None:
    """Store a frame."""
    query = (
        "INSERT INTO frames (map, row, descriptor, local, keypoints, picture, object, object_size, object_digest)"
        " VALUES (%s, %s, %s, %s, %s, %s, %s, %s, %s)"
    )
    values = (map_number, row, frame.descriptor, frame.local, frame.keypoints)
    connection.execute(query, (*values, *columns_of(frame.picture)))


def put_keypoints(connection: Connection[Any], map_number: int, row: int, keypoints: bytes) -> bool:
    """Store the keypoints of a frame if it has none; returns whether it had none."""
    query = "UPDATE frames SET keypoints = %s WHERE map = %s AND row = %s AND keypoints IS NULL"
    return connection.execute(query, (keypoints, map_number, row)).rowcount > 0


def without_keypoints(connection: Connection[Any], map_number: int, after: int, limit: int) -> list[PicturedPlace]:
    """Up to ``limit`` places behind number ``after`` that keep a picture and no keypoints."""
    query = (
        "SELECT p.number, p.id, p.digest, p.camera, p.picture FROM places p"
        " JOIN frames f ON f.map = p.map AND f.row = p.row"
        " WHERE p.map = %s AND p.number > %s AND (f.picture IS NOT NULL OR f.object IS NOT NULL)"
        " AND f.keypoints IS NULL ORDER BY p.number LIMIT %s"
    )
    return [PicturedPlace(*values) for values in connection.execute(query, (map_number, after, limit))]


def count_without_image(connection: Connection[Any], map_number: int) -> int:
    """How many places keep no original image."""
    query = "SELECT count(*) FROM places WHERE map = %s AND picture <> 'image'"
    ((count,),) = connection.execute(query, (map_number,)).fetchall()
    return int(count)


def room(connection: Connection[Any], map_number: int) -> tuple[int, int, int, int]:
    """The bytes of descriptors, of pictures wherever they are, of keypoints, and of how many frames these are."""
    query = (
        "SELECT coalesce(sum(octet_length(descriptor) + octet_length(local)), 0),"
        " coalesce(sum(coalesce(octet_length(picture), object_size)), 0),"
        " coalesce(sum(octet_length(keypoints)), 0), count(keypoints)"
        " FROM frames WHERE map = %s"
    )
    (sizes,) = connection.execute(query, (map_number,)).fetchall()
    descriptors, pictures, keypoints, places = (int(size) for size in sizes)
    return descriptors, pictures, keypoints, places


def of_frames(connection: Connection[Any], map_number: int, column: str, rows: Sequence[int]) -> dict[int, Any]:
    """A column of frames by row; rows that are gone are left out."""
    query = f"SELECT row, {column} FROM frames WHERE map = %s AND row = ANY(%s)"
    return dict(connection.execute(query, (map_number, list(rows))).fetchall())


def pictures_of(connection: Connection[Any], map_number: int, rows: Sequence[int]) -> dict[int, StoredPicture]:
    """The stored pictures of frames by row; rows that are gone are left out."""
    query = "SELECT row, picture, object, object_size, object_digest FROM frames WHERE map = %s AND row = ANY(%s)"
    found = connection.execute(query, (map_number, list(rows)))
    return {row: stored_picture(*picture) for row, *picture in found}


def columns_of(picture: StoredPicture) -> tuple[bytes | None, str | None, int | None, bytes | None]:
    """The columns of a picture."""
    if isinstance(picture, StoredObject):
        return None, picture.name, picture.size, picture.digest
    return picture, None, None, None


def stored_picture(picture: bytes | None, name: str | None, size: int | None, digest: bytes | None) -> StoredPicture:
    """A picture from its columns."""
    return picture if name is None or size is None or digest is None else StoredObject(name, size, digest)


# Objects


def objects_folder(connection: Connection[Any]) -> str:
    """The folder of the database's pictures in an object store, which no other database has."""
    ((folder,),) = connection.execute("SELECT objects FROM placerec").fetchall()
    return str(folder)


def new_object_key(connection: Connection[Any]) -> tuple[str, int]:
    """That folder, and a number that was never used before."""
    ((folder, key),) = connection.execute("SELECT objects, nextval('keys') FROM placerec").fetchall()
    return folder, int(key)


def dead_objects(connection: Connection[Any]) -> list[str]:
    """The names of some objects whose row is deleted; none while a map is exported, which may still see the row."""
    if connection.execute("SELECT pg_try_advisory_xact_lock(%s::int, 0)", (EXPORTING,)).fetchone() != (True,):
        return []
    return [name for (name,) in connection.execute("SELECT name FROM dead_objects LIMIT %s", (ORPHANS_AT_ONCE,))]


def clear_objects(connection: Connection[Any], names: Sequence[str]) -> None:
    """Forget dead objects, which are deleted."""
    connection.execute("DELETE FROM dead_objects WHERE name = ANY(%s)", (list(names),))


def known_objects(connection: Connection[Any], names: Sequence[str]) -> set[str]:
    """Those of some objects that a row names, or named."""
    columns = ("object", "frames"), ("object", "review_frames"), ("name", "dead_objects")
    query = " UNION ".join(f"SELECT {column} FROM {table} WHERE {column} = ANY(%(names)s)" for column, table in columns)
    return {name for (name,) in connection.execute(query, {"names": list(names)})}


def swept_objects(connection: Connection[Any], whole_seconds: float) -> int:
    """The key from which on objects may be litter; 0 if the last full listing is older than ``whole_seconds``."""
    query = "SELECT swept FROM placerec WHERE listed > now() - make_interval(secs => %s)"
    found = connection.execute(query, (whole_seconds,)).fetchone()
    return 0 if found is None else int(found[0])


def note_swept_objects(connection: Connection[Any], key: int, whole: bool) -> None:
    """Note that there is no litter up to a key, and whether all objects were listed for that."""
    query = "UPDATE placerec SET swept = %s, listed = CASE WHEN %s THEN now() ELSE listed END"
    connection.execute(query, (key, whole))


# Orphans


def leave(connection: Connection[Any], map_number: int, key: int, row: int | None) -> None:
    """Note that an entity, and the frame of a row, are no place's any more."""
    connection.execute("INSERT INTO leavings (map, key, row) VALUES (%s, %s, %s)", (map_number, key, row))


def orphans(connection: Connection[Any], map_number: int) -> list[int]:
    """The keys of the entities that are no place's any more."""
    query = "SELECT key FROM leavings WHERE map = %s ORDER BY since DESC LIMIT %s"
    return [key for (key,) in connection.execute(query, (map_number, ORPHANS_AT_ONCE))]


def old_orphans(connection: Connection[Any], map_number: int) -> list[int]:
    """The keys of some that can be deleted; others, who delete too, get other ones."""
    query = (
        "SELECT key FROM leavings WHERE map = %s AND since < now() - make_interval(secs => %s)"
        " ORDER BY since LIMIT %s FOR UPDATE SKIP LOCKED"
    )
    return [key for (key,) in connection.execute(query, (map_number, LEFT_SECONDS, ORPHANS_AT_ONCE))]


def clear(connection: Connection[Any], map_number: int, keys: Sequence[int]) -> None:
    """Delete the frames of orphans with deleted entities, and the record of these orphans."""
    query = "DELETE FROM leavings WHERE map = %s AND key = ANY(%s) RETURNING row"
    rows = [row for (row,) in connection.execute(query, (map_number, list(keys))) if row is not None]
    connection.execute("DELETE FROM frames WHERE map = %s AND row = ANY(%s)", (map_number, rows))


# All keys


def known_keys(connection: Connection[Any], keys: Sequence[int]) -> set[int]:
    """Those of some keys that are a place's, or were one's a while ago."""
    query = "SELECT key FROM places WHERE key = ANY(%s) UNION SELECT key FROM leavings WHERE key = ANY(%s)"
    return {key for (key,) in connection.execute(query, (list(keys), list(keys)))}


def last_key(connection: Connection[Any]) -> int:
    """No later key is at most this."""
    ((key,),) = connection.execute("SELECT last_value FROM keys").fetchall()
    return int(key)


def map_numbers(connection: Connection[Any]) -> list[int]:
    """The numbers of all maps, also of unlisted ones."""
    return [number for (number,) in connection.execute("SELECT number FROM maps ORDER BY number")]


def encoders(connection: Connection[Any]) -> list[tuple[str, int]]:
    """The encoders of all maps, each with the values of its descriptors."""
    found = {(r.encoder, r.dimension) for r in map(_record, connection.execute("SELECT record FROM maps"))}
    return sorted(found)


def _record(values: tuple[str]) -> MapRecord:
    return MapRecord.model_validate_json(values[0])
