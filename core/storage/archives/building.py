"""Making the folder of a new map from an export file; every descriptor gets new checksums."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.disk.files import Damage, sync_file, sync_folder
from core.disk.sqlite_file import transaction
from core.errors import InvalidArchive, InvalidField
from core.maps.archives.lines import MOST_PICTURE_BYTES, CameraLine, PlaceLine, SequenceLine
from core.maps.archives.reading import Archive
from core.maps.records import MapRecord
from core.maps.stored_fields import field_columns, moment_text
from core.places import NO_SEQUENCE
from core.storage.archives.unpacking import Advance, CheckPicture, Content, Unpacking, check_sizes, layout_of
from core.storage.database import keypoints, ledger, row_checksums
from core.storage.database.connections import FILE, connect
from core.storage.database.ledger import segment_entries
from core.storage.files import segment_files as descriptors
from core.storage.files.segment_files import ROWS_PER_SEGMENT
from core.storage.opening import create_folder
from core.storage.writing import record_appended

MOST_CODES = 1024
"""Sequences whose codes are remembered at a time."""


def build(
    archive: Archive,
    folder: Path,
    map_id: str,
    rows_per_segment: int = ROWS_PER_SEGMENT,
    advance: Advance = lambda _done, _all: None,
    check_picture: CheckPicture = lambda _content: None,
    most_picture_bytes: int = MOST_PICTURE_BYTES,
) -> None:
    """Make ``folder`` with the map of an export file in it, durable except for the folder's own name.

    Args:
        map_id: of the new map; it may differ from that in the file.
        most_picture_bytes: a larger picture is refused before it is read.

    Raises:
        InvalidArchive: the file is damaged, or its content is not valid for a map; ``folder`` is then of no use.
        OSError, sqlite3.Error: the disk refuses.
    """
    manifest = archive.manifest
    check_sizes(manifest)
    record = MapRecord.model_validate({**manifest.map.model_dump(), "id": map_id})
    create_folder(folder, record, rows_per_segment)
    connection = connect(folder / FILE)
    try:
        layout = layout_of(manifest, rows_per_segment)
        building = _Building(archive, layout, advance, check_picture, most_picture_bytes)
        building.into(folder, connection)
    except sqlite3.IntegrityError as error:
        raise InvalidArchive(f"The places of the file cannot be those of one map: {error}.") from None
    finally:
        connection.close()  # SQLite moves its log into the file and deletes it
    sync_file(folder / FILE)
    sync_folder(folder)


class _Building(Unpacking):
    def into(self, folder: Path, connection: sqlite3.Connection) -> None:
        """Make the map in a new folder, whose database this is."""
        self.folder, self.connection = folder, connection
        self.codes: dict[str, int] = {}
        """The codes of the last sequences of places."""
        self.lost: dict[int, int] = {}
        """The codes of the tracks whose sequences are gone, by their numbers in the file."""
        self.unpack()
        self._check()

    def put_sequences_and_cameras(self, sequences: Iterator[SequenceLine], cameras: Iterator[CameraLine]) -> None:
        with transaction(self.connection):
            for line in sequences:
                if line.name is None:
                    query = "UPDATE sequences SET next_ordinal = ? WHERE name IS NULL"
                    self.connection.execute(query, (line.next_ordinal,))
                else:
                    query = "INSERT INTO sequences (name, next_ordinal) VALUES (?, ?)"
                    self.connection.execute(query, (line.name, line.next_ordinal))
            for camera in cameras:
                mask = None if camera.mask is None else camera.mask.model_dump_json()
                intrinsics = None if camera.intrinsics is None else camera.intrinsics.model_dump_json()
                query = "INSERT INTO cameras (name, mask, intrinsics, updated_at) VALUES (?, ?, ?, ?)"
                self.connection.execute(query, (camera.name, mask, intrinsics, moment_text(camera.updated_at)))
            row_checksums.write_checksums(self.connection, "cameras")

    def put_places(self, lines: Sequence[PlaceLine], frames: NDArray[np.void], contents: Iterator[Content]) -> None:
        """Append the descriptors of places, then store the places with pictures and keypoints in one COMMIT."""
        made = self.layout.records_of(frames, self.rows)
        descriptors.append(self.folder, self.layout, self.rows, made)
        checksums: list[int] = made["checksum"].tolist()
        with transaction(self.connection):
            for row, (line, checksum) in enumerate(zip(lines, checksums, strict=True), start=self.rows):
                number = self._insert(line, row, checksum)
                content = next(contents)
                if content.picture is not None:
                    query = "INSERT INTO pictures (place, bytes, digest) VALUES (?, ?, ?)"
                    self.connection.execute(query, (number, *content.picture))
                if content.keypoints is not None:
                    keypoints.put(self.connection, number, bytes.fromhex(line.digest), content.keypoints)
            row_checksums.write_checksums(self.connection, "places", "row >= ?", self.rows)
            record_appended(self.connection, self.layout, self.rows, checksums)

    def _insert(self, line: PlaceLine, row: int, checksum: int) -> int:
        """Store a place without its picture and keypoints; returns its number."""
        code = NO_SEQUENCE if line.sequence is None else self._code(line.sequence, line)
        try:
            columns = field_columns(line.fields())
        except InvalidField as error:
            raise InvalidArchive(f"The place {line.id!r} cannot be stored: {error}") from None
        columns |= {
            "id": line.id,
            "row": row,
            "checksum": checksum,
            "digest": bytes.fromhex(line.digest),
            "regions": line.regions,
            "picture": "none" if line.picture is None else line.picture.kind,
            "sequence": code,
            "ordinal": line.ordinal,
            "track": self._track(line),
            "station": line.station,
            "pose_of": line.pose_of,
            "created_at": moment_text(line.created_at),
            "updated_at": moment_text(line.updated_at),
        }
        names, marks = ", ".join(columns), ", ".join("?" * len(columns))
        query = f"INSERT INTO places ({names}) VALUES ({marks})"
        number = self.connection.execute(query, tuple(columns.values())).lastrowid
        assert number is not None
        return number

    def _code(self, name: str, line: PlaceLine) -> int:
        """The code of a sequence in the tables."""
        if name not in self.codes:
            found = self.connection.execute("SELECT code FROM sequences WHERE name = ?", (name,)).fetchone()
            if found is None:
                raise InvalidArchive(f"The place {line.id!r} is of a sequence that the file does not list.")
            if len(self.codes) >= MOST_CODES:
                self.codes.clear()
            self.codes[name] = found[0]
        return self.codes[name]

    def _track(self, line: PlaceLine) -> int | None:
        """The code of a place's track; one whose sequence is gone gets a code that no sequence will ever have."""
        if line.track is None or isinstance(line.track, str):
            return None if line.track is None else self._code(line.track, line)
        if line.track not in self.lost:
            self.lost[line.track] = ledger.new_track(self.connection)
        return self.lost[line.track]

    def _check(self) -> None:
        """Check conditions across places; each place was checked by itself."""
        query = (
            "SELECT s.name FROM sequences s LEFT JOIN places p ON p.sequence = s.code GROUP BY s.code"
            " HAVING coalesce(max(p.ordinal), -1) >= s.next_ordinal OR (s.name IS NOT NULL AND count(p.number) = 0)"
        )
        if wrong := self.connection.execute(query).fetchone():
            raise InvalidArchive(f"The sequence {wrong[0]!r} is empty, or its places stand behind its end.")
        for (line,) in self.connection.execute("PRAGMA quick_check").fetchall():
            if line != "ok":
                raise Damage(f"{FILE}: {line}")
        if sum(segment.rows for segment in segment_entries(self.connection, self.layout)) != self.rows:
            raise Damage(f"{FILE} does not record the rows that were written")
