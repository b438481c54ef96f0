"""Making the folder of a new map from an export file.

The file holds lines of text and never a database: every value is checked and written by our own statements into a new
database, and every descriptor gets new checksums.  So an export file can bring nothing but values.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.disk.files import Damage, sync_file, sync_folder
from core.disk.sqlite_file import transaction
from core.errors import InvalidArchive, InvalidField, InvalidImage, InvalidKeypoints
from core.geometry.keypoints import MOST, keypoints_of, record_bytes
from core.maps.cameras import MOST_CAMERAS
from core.maps.records import MapRecord
from core.places import NO_SEQUENCE
from core.storage.archives.lines import MOST_PICTURE_BYTES, CameraLine, Kind, PlaceLine, SequenceLine, read_line
from core.storage.archives.manifest import Manifest, Part
from core.storage.archives.reading import Archive, PartReader
from core.storage.database import keypoints, ledger, row_checksums
from core.storage.database.connections import FILE, connect
from core.storage.database.ledger import moment_text, segment_entries
from core.storage.files import segment_files as descriptors
from core.storage.files.row_formats import LARGEST_HALF
from core.storage.files.segment_files import ROWS_PER_SEGMENT, Layout
from core.storage.opening import create_folder
from core.storage.writing import record_appended

CHUNK_BYTES = 16 << 20
"""Bytes of descriptors that are written, synced and committed together."""

TEXT_BYTES = 2 << 20
"""Bytes of lines that are committed together; parsed, they take many times as much memory."""

MOST_PLACE_BYTES = 1 << 30
"""Most bytes of one descriptor with its local descriptors, as float32."""

MOST_CODES = 1024
"""Sequences whose codes are remembered at a time."""

LINES_BETWEEN = 1024
"""After so many lines of sequences ``advance`` is called, which may end the work."""

Advance = Callable[[int, int], None]
"""Is called with the number of places done and of all; what it raises ends the work."""

CheckPicture = Callable[[bytes], None]
"""Raises InvalidImage for bytes that must not be shown as a picture."""


def layout_of(manifest: Manifest, rows_per_segment: int = ROWS_PER_SEGMENT) -> Layout:
    """The layout of the descriptors in an export file.

    Raises:
        InvalidArchive: it is impossible.
    """
    record = manifest.map
    if 4 * record.dimension + record.local_cells * record.local_values > MOST_PLACE_BYTES:  # too large for numpy
        raise InvalidArchive(f"The manifest is impossible: a place has more than {MOST_PLACE_BYTES} bytes.")
    try:
        layout = Layout(record.dimension, record.encoder, rows_per_segment, record.local_shape, record.precision)
        _ = layout.record, layout.frame  # numpy raises ValueError for impossible types
        return layout
    except ValueError as error:
        raise InvalidArchive(f"The manifest is impossible: {error}.") from None


def check_sizes(manifest: Manifest) -> None:
    """Check that the parts of descriptors and keypoints have a size that their places may need.

    Raises:
        InvalidArchive.
    """
    width = layout_of(manifest).frame.itemsize
    for number in range(manifest.groups):
        _, part, _, *more = manifest.group(number)
        if part.bytes != part.rows * width:
            raise InvalidArchive(f"{part.name} has {part.bytes} bytes, not {part.rows} times {width} bytes.")
        for part in more:
            if part.bytes > part.rows * record_bytes(MOST):
                raise InvalidArchive(f"{part.name} has more bytes than the keypoints of {part.rows} places.")


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
        _Building(archive, folder, connection, layout, advance, check_picture, most_picture_bytes).run()
        archive.check_end()
    except sqlite3.IntegrityError as error:
        raise InvalidArchive(f"The places of the file cannot be those of one map: {error}.") from None
    finally:
        connection.close()  # SQLite moves its log into the file and deletes it
    sync_file(folder / FILE)
    sync_folder(folder)


class _Building:
    def __init__(
        self,
        archive: Archive,
        folder: Path,
        connection: sqlite3.Connection,
        layout: Layout,
        advance: Advance,
        check_picture: CheckPicture,
        most_picture_bytes: int,
    ) -> None:
        self.archive, self.folder, self.connection = archive, folder, connection
        self.layout, self.advance, self.check_picture = layout, advance, check_picture
        self.most_picture_bytes = most_picture_bytes
        self.codes: dict[str, int] = {}
        """The codes of the last sequences of places."""
        self.lost: dict[int, int] = {}
        """The codes of the tracks whose sequences are gone, by their numbers in the file."""
        self.rows = 0

    def run(self) -> None:
        manifest = self.archive.manifest
        with transaction(self.connection):
            self._sequences(manifest.parts[0])
            self._cameras(manifest.parts[1])
        for number in range(manifest.groups):
            self._group(*manifest.group(number))
        self._check()

    def _sequences(self, part: Part) -> None:
        places = self.archive.manifest.places
        if part.rows > places + 1:
            raise InvalidArchive(f"{part.name}: {places} places are in no more than {places + 1} sequences.")
        reader = self.archive.part(part)
        for number, (line, _) in enumerate(_lines(reader, part, SequenceLine), start=1):
            if number % LINES_BETWEEN == 0:
                self.advance(0, places)
            if line.name is None:
                query = "UPDATE sequences SET next_ordinal = ? WHERE name IS NULL"
                self.connection.execute(query, (line.next_ordinal,))
            else:
                query = "INSERT INTO sequences (name, next_ordinal) VALUES (?, ?)"
                self.connection.execute(query, (line.name, line.next_ordinal))
        reader.finish()

    def _cameras(self, part: Part) -> None:
        if part.rows > MOST_CAMERAS:
            raise InvalidArchive(f"{part.name}: a map has at most {MOST_CAMERAS} cameras.")
        reader = self.archive.part(part)
        for line, _ in _lines(reader, part, CameraLine):
            mask = None if line.mask is None else line.mask.model_dump_json()
            intrinsics = None if line.intrinsics is None else line.intrinsics.model_dump_json()
            values = (line.name, mask, intrinsics, moment_text(line.updated_at))
            self.connection.execute(
                "INSERT INTO cameras (name, mask, intrinsics, updated_at) VALUES (?, ?, ?, ?)", values
            )
        row_checksums.write_checksums(self.connection, "cameras")
        reader.finish()

    def _group(self, places: Part, frames: Part, *more: Part) -> None:
        lines, rows, *others = (self.archive.part(part) for part in (places, frames, *more))
        step = max(1, CHUNK_BYTES // self.layout.record.itemsize)
        chunk: list[PlaceLine] = []
        held = 0
        for line, size in _lines(lines, places, PlaceLine):
            chunk.append(line)
            held += size
            if len(chunk) == step or held >= TEXT_BYTES:
                self._commit(chunk, rows, *others)
                chunk, held = [], 0
        self._commit(chunk, rows, *others)
        for reader in (lines, rows, *others):
            reader.finish()

    def _commit(
        self, chunk: list[PlaceLine], rows: PartReader, images: PartReader, records: PartReader | None = None
    ) -> None:
        """Append the descriptors of places, then store the places with pictures and keypoints in one COMMIT."""
        if not chunk:
            return
        kept = np.frombuffer(rows.read(len(chunk) * self.layout.frame.itemsize), self.layout.frame)
        self._check_descriptors(kept, chunk, rows.name)
        made = self.layout.records_of(kept, self.rows)
        descriptors.append(self.folder, self.layout, self.rows, made)
        checksums: list[int] = made["checksum"].tolist()
        with transaction(self.connection):
            for row, (line, checksum) in enumerate(zip(chunk, checksums, strict=True), start=self.rows):
                number = self._insert(line, row, checksum)
                self._insert_picture(line, number, images)
                self._insert_keypoints(line, number, records)
            row_checksums.write_checksums(self.connection, "places", "row >= ?", self.rows)
            record_appended(self.connection, self.layout, self.rows, checksums)
        self.rows += len(chunk)
        self.advance(self.rows, self.archive.manifest.places)

    def _check_descriptors(self, kept: NDArray[np.void], chunk: list[PlaceLine], name: str) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            vectors = self.layout.descriptors_of(kept)
            largest = np.abs(vectors).max(axis=1)
        for line, value in zip(chunk, largest.tolist(), strict=True):
            if not 0 < value <= LARGEST_HALF:  # this is also false for NaN
                raise InvalidArchive(f"{name}: the descriptor of place {line.id!r} cannot be compared.")

    def _insert(self, line: PlaceLine, row: int, checksum: int) -> int:
        """Store a place without its picture and keypoints; returns its number."""
        code = NO_SEQUENCE if line.sequence is None else self._code(line.sequence, line)
        try:
            columns = ledger.field_columns(line.fields())
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

    def _insert_picture(self, line: PlaceLine, number: int, images: PartReader) -> None:
        if line.picture is None:
            return
        if line.picture.bytes > self.most_picture_bytes:
            more = f"it has {line.picture.bytes} bytes of at most {self.most_picture_bytes}"
            raise InvalidArchive(f"The picture of place {line.id!r} cannot be taken: {more}.")
        content = images.read(line.picture.bytes)
        digest = hashlib.sha256(content).digest()
        if digest.hex() != line.picture.sha256:
            raise InvalidArchive(f"The picture of place {line.id!r} does not match its SHA-256.")
        try:
            self.check_picture(content)
        except InvalidImage as error:
            raise InvalidArchive(f"The picture of place {line.id!r} cannot be taken: {error}") from None
        self.connection.execute(
            "INSERT INTO pictures (place, digest, bytes) VALUES (?, ?, ?)", (number, digest, content)
        )

    def _insert_keypoints(self, line: PlaceLine, number: int, records: PartReader | None) -> None:
        if line.keypoints is None:
            return
        if records is None:
            raise InvalidArchive(f"The place {line.id!r} has keypoints, which files of version 1 do not hold.")
        record = records.read(record_bytes(line.keypoints))
        try:
            keypoints_of(record)
        except InvalidKeypoints as error:
            raise InvalidArchive(f"The keypoints of place {line.id!r} cannot be taken: {error}") from None
        keypoints.put(self.connection, number, bytes.fromhex(line.digest), record)

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
        """Check what concerns several places; each place was checked by itself."""
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


def _lines(reader: PartReader, part: Part, kind: type[Kind]) -> Iterator[tuple[Kind, int]]:
    """The lines of a part, as many as the manifest says, each with the length of its text."""
    seen = 0
    for text in reader.lines():
        seen += 1
        if seen > part.rows:
            raise InvalidArchive(f"{part.name} has more lines, not {part.rows}.")
        yield read_line(text, kind, f"{part.name}, line {seen}"), len(text)
    if seen != part.rows:
        raise InvalidArchive(f"{part.name} has {seen} lines, not {part.rows}.")
