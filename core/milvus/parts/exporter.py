"""Exporting a map: its state of one moment as one file, the same as from a data directory."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psycopg import Connection

from core.disk.files import disk_errors
from core.errors import StorageFailure
from core.geometry.keypoints import count_of
from core.maps.archives.lines import written_line
from core.maps.archives.manifest import ArchivedRecord
from core.maps.archives.writing import Advance, ArchivedPlace, Expect, Exported, write_archive
from core.maps.cameras import CameraRecord
from core.maps.stored_fields import metadata_text, moment_text
from core.milvus import ledger
from core.milvus.database import Database
from core.milvus.forms import Form
from core.milvus.ledger import MapState
from core.milvus.pictures.stored import StoredPicture, digest_of, read_pictures, size_of
from core.places import Pose

if TYPE_CHECKING:
    from core.milvus.pictures.objects import Objects

READ_AT_ONCE = 16
"""Frames whose descriptors, pictures or keypoints are read together."""

Viewing = Callable[[], AbstractContextManager[tuple[Connection[Any], MapState]]]


class MilvusExporter:
    """Writes export files of one map (:class:`core.maps.store.Exporter`).

    Args:
        viewing: begins a transaction that reads the map, whose state comes with it.
        state: a value that is the same as long as nothing is written to the map.
        database: in which the map is.
        objects: where pictures may be besides; None: nowhere.
    """

    def __init__(
        self, viewing: Viewing, state: Callable[[], object], database: Database, objects: Objects | None
    ) -> None:
        self._viewing, self.state, self._database, self._objects = viewing, state, database, objects

    def write(
        self, path: Path, advance: Advance = lambda _written: None, expect: Expect = lambda _size: None
    ) -> Exported:
        """Write the present state of the map as a new file, which a crash may lose; nothing is left if this raises.

        Raises:
            UnknownMap: the map was deleted before it was read.
            StorageFull, StorageFailure.
        """
        with disk_errors(f"write {path}"), self._keeping_objects(), self._viewing() as (connection, state):
            source = _Source(connection, state, self._objects)
            return write_archive(source, path, advance, expect)

    def _keeping_objects(self) -> AbstractContextManager[object]:
        """Have no objects deleted during the block: its transaction still sees rows that are deleted meanwhile."""
        if self._objects is None:
            return nullcontext()
        return self._database.locked("export a map", ledger.EXPORTING, 0, shared=True)


class _Source:
    """A map as one transaction sees it (:class:`core.maps.archives.writing.ArchiveSource`)."""

    def __init__(self, connection: Connection[Any], state: MapState, objects: Objects | None) -> None:
        self._connection, self._map, self._objects = connection, state.number, objects
        self.record = ArchivedRecord.model_validate(state.record.model_dump())
        self.frame_bytes = Form(state.record).frame_bytes

    def sequence_lines(self) -> Iterator[bytes]:
        for name, following in ledger.sequence_ends(self._connection, self._map).items():
            yield written_line({"name": name, "next_ordinal": following})

    def camera_lines(self) -> Iterator[bytes]:
        query = "SELECT record FROM cameras WHERE map = %s ORDER BY name"
        for (text,) in self._connection.execute(query, (self._map,)):
            camera = CameraRecord.model_validate_json(text)
            values = {name: json.loads(camera.model_dump_json(include={name}))[name] for name in ("mask", "intrinsics")}
            yield written_line({"name": camera.name, **values, "updated_at": moment_text(camera.updated_at)})

    def places(self) -> Iterator[ArchivedPlace]:
        query = (
            "SELECT p.number, p.row, p.key, p.digest, p.sequence, p.ordinal, p.place, p.track, p.station, t.name,"
            " f.picture, f.object, f.object_size, f.object_digest, octet_length(f.keypoints)"
            " FROM places p JOIN frames f ON f.map = p.map AND f.row = p.row"
            " LEFT JOIN sequences t ON t.map = p.map AND t.code = p.track AND t.name IS NOT NULL"
            " WHERE p.map = %s ORDER BY p.number"
        )
        lost: dict[int, int] = {}
        with self._connection.cursor(name="placerec_export") as cursor:
            cursor.itersize = READ_AT_ONCE
            for *columns, track, picture, name, size, digest, keypoints in cursor.execute(query, (self._map,)):
                stored = ledger.stored_picture(picture, name, size, digest)
                yield _place(ledger.entry_of(tuple(columns)), track, stored, keypoints, lost)

    def frames(self, group: Sequence[ArchivedPlace]) -> Iterator[bytes]:
        for some in _in_pieces(group):
            rows = [place.row for place in some]
            descriptors, local = (
                ledger.of_frames(self._connection, self._map, column, rows) for column in ("descriptor", "local")
            )
            yield b"".join(descriptors[row] + local[row] for row in rows)

    def pictures(self, group: Sequence[ArchivedPlace]) -> Iterator[bytes]:
        for some in _in_pieces([place for place in group if place.picture_bytes]):
            stored = ledger.pictures_of(self._connection, self._map, [place.row for place in some])
            found = read_pictures(self._objects, stored)
            for place in some:
                picture = found.get(place.row)
                if picture is None:
                    raise StorageFailure(
                        f"The picture of place {place.id!r} is missing in the object store, or damaged."
                    )
                yield picture

    def keypoints(self, group: Sequence[ArchivedPlace]) -> Iterator[bytes]:
        return self._column("keypoints", [place for place in group if place.keypoints_bytes])

    def _column(self, column: str, group: Sequence[ArchivedPlace]) -> Iterator[bytes]:
        for some in _in_pieces(group):
            rows = [place.row for place in some]
            found = ledger.of_frames(self._connection, self._map, column, rows)
            yield from (found[row] for row in rows)

    def expect_there(self) -> None:
        """The transaction sees the map also if it was deleted since."""


def _in_pieces(group: Sequence[ArchivedPlace]) -> Iterator[Sequence[ArchivedPlace]]:
    for first in range(0, len(group), READ_AT_ONCE):
        yield group[first : first + READ_AT_ONCE]


def _place(
    entry: ledger.PlaceEntry, track: str | None, picture: StoredPicture, keypoints: int | None, lost: dict[int, int]
) -> ArchivedPlace:
    """The line of a place.

    Args:
        track: the name of its track; None: it has none, or the sequence is gone.
        keypoints: bytes of their record.
        lost: the numbers of the tracks whose sequence is gone, by their codes; it gets those that it lacks.
    """
    place = entry.place
    described = None
    if picture is not None:
        described = {"kind": place.picture, "bytes": size_of(picture), "sha256": digest_of(picture).hex()}
    text = written_line(
        {
            "id": place.id,
            "pose": _pose(place.pose),
            "pose_of": place.pose_of,
            "timestamp": None if place.timestamp is None else moment_text(place.timestamp),
            "sequence": place.sequence,
            "ordinal": entry.ordinal,
            "track": None if entry.track is None else track or lost.setdefault(entry.track, len(lost)),
            "station": entry.station,
            "camera": place.camera,
            "metadata": json.loads(metadata_text(place.metadata)),
            "regions": place.regions,
            "digest": entry.digest.hex(),
            "picture": described,
            "keypoints": None if keypoints is None else count_of(keypoints),
            "created_at": moment_text(place.created_at),
            "updated_at": moment_text(place.updated_at),
        }
    )
    return ArchivedPlace(place.id, text, entry.number, entry.row, 0, size_of(picture), keypoints or 0)


def _pose(pose: Pose | None) -> dict[str, float] | None:
    if pose is None:
        return None
    named = ("x", "y", "z", "latitude", "longitude", "heading")
    return {name: value for name in named if (value := getattr(pose, name)) is not None}
