"""The folder of a new map out of an export file.

The file's tables are lines of text, never a database that somebody else made: every value is checked and written by
our own statements into a fresh database, every descriptor sealed anew.  So nothing but values can come along.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidArchive, InvalidField, InvalidImage
from core.storage import descriptors, ledger, seals
from core.storage.archives.lines import CameraLine, PlaceLine, SequenceLine, read_line
from core.storage.archives.manifest import Manifest, Part
from core.storage.archives.reading import Archive, PartReader
from core.storage.cameras import MOST_CAMERAS
from core.storage.database import FILE, connect
from core.storage.descriptors import ROWS_PER_SEGMENT, Layout
from core.storage.disk import Damage, sync_file, sync_folder
from core.storage.ledger import moment_text
from core.storage.named import named_segments
from core.storage.opening import create_folder
from core.storage.records import MapRecord
from core.storage.resting import LARGEST_HALF
from core.storage.schema import NO_SEQUENCE
from core.storage.writing import name_appended

CHUNK_BYTES = 16 << 20
"""Of descriptors that are written, synced and committed together."""

Advance = Callable[[int, int], None]
"""Is told how many places of how many are there; may raise to break the work off."""

CheckPicture = Callable[[bytes], None]
"""Raises InvalidImage for bytes that nobody should be shown as a picture."""


def layout_of(manifest: Manifest, rows_per_segment: int = ROWS_PER_SEGMENT) -> Layout:
    """How the descriptors of a file are kept.

    Raises:
        InvalidArchive: in a way that cannot be.
    """
    record = manifest.map
    try:
        return Layout(record.dimension, record.encoder, rows_per_segment, record.local_shape, record.precision)
    except ValueError as error:
        raise InvalidArchive(f"The manifest says what cannot be: {error}.") from None


def check_sizes(manifest: Manifest) -> None:
    """See that the parts of descriptors are as long as their places need.

    Raises:
        InvalidArchive.
    """
    width = layout_of(manifest).frame.itemsize
    for number in range(manifest.groups):
        part = manifest.group(number)[1]
        if part.bytes != part.rows * width:
            raise InvalidArchive(f"{part.name} is to have {part.bytes} bytes for {part.rows} places of {width} bytes.")


def build(
    archive: Archive,
    folder: Path,
    map_id: str,
    rows_per_segment: int = ROWS_PER_SEGMENT,
    advance: Advance = lambda _done, _all: None,
    check_picture: CheckPicture = lambda _content: None,
) -> None:
    """Make ``folder`` and in it the map of a file, under another id if need be, synced but for the folder's own name.

    Raises:
        InvalidArchive: the file is damaged, or holds what no map may hold.  What is in ``folder`` is then of no use.
        OSError, sqlite3.Error: the disk refuses.
    """
    manifest = archive.manifest
    check_sizes(manifest)
    record = MapRecord.model_validate({**manifest.map.model_dump(), "id": map_id})
    create_folder(folder, record, rows_per_segment)
    connection = connect(folder / FILE)
    try:
        layout = layout_of(manifest, rows_per_segment)
        _Building(archive, folder, connection, layout, advance, check_picture).run()
        archive.check_end()
    except sqlite3.IntegrityError as error:
        raise InvalidArchive(f"The places of the file cannot be those of one map: {error}.") from None
    finally:
        connection.close()  # the log goes into the file and is removed
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
    ) -> None:
        self.archive, self.folder, self.connection = archive, folder, connection
        self.layout, self.advance, self.check_picture = layout, advance, check_picture
        self.codes: dict[str | None, int] = {None: NO_SEQUENCE}
        self.rows = 0

    def run(self) -> None:
        manifest = self.archive.manifest
        self.connection.execute("BEGIN IMMEDIATE")
        self._sequences(manifest.parts[0])
        self._cameras(manifest.parts[1])
        self.connection.execute("COMMIT")
        for number in range(manifest.groups):
            self._group(*manifest.group(number))
        self._check()

    def _sequences(self, part: Part) -> None:
        reader, seen = self.archive.part(part), 0
        for number, text in enumerate(reader.lines(), start=1):
            line = read_line(text, SequenceLine, f"{part.name}, line {number}")
            if line.name is None:
                query = "UPDATE sequences SET next_ordinal = ? WHERE name IS NULL"
                self.connection.execute(query, (line.next_ordinal,))
            else:
                query = "INSERT INTO sequences (name, next_ordinal) VALUES (?, ?)"
                code = self.connection.execute(query, (line.name, line.next_ordinal)).lastrowid
                assert code is not None
                self.codes[line.name] = code
            seen = number
        _finish(reader, part, seen)

    def _cameras(self, part: Part) -> None:
        if part.rows > MOST_CAMERAS:
            raise InvalidArchive(f"{part.name}: a map has at most {MOST_CAMERAS} cameras.")
        reader, seen = self.archive.part(part), 0
        for number, text in enumerate(reader.lines(), start=1):
            line = read_line(text, CameraLine, f"{part.name}, line {number}")
            mask = None if line.mask is None else line.mask.model_dump_json()
            values = (line.name, mask, moment_text(line.updated_at))
            self.connection.execute("INSERT INTO cameras (name, mask, updated_at) VALUES (?, ?, ?)", values)
            seen = number
        seals.seal(self.connection, "cameras")
        _finish(reader, part, seen)

    def _group(self, places: Part, frames: Part, pictures: Part) -> None:
        lines, rows, images = (self.archive.part(part) for part in (places, frames, pictures))
        seen = 0
        step = max(1, CHUNK_BYTES // self.layout.record.itemsize)
        chunk: list[PlaceLine] = []
        for number, text in enumerate(lines.lines(), start=1):
            chunk.append(read_line(text, PlaceLine, f"{places.name}, line {number}"))
            if len(chunk) == step:
                self._commit(chunk, rows, images)
                chunk = []
            seen = number
        self._commit(chunk, rows, images)
        _finish(lines, places, seen)
        rows.finish()
        images.finish()

    def _commit(self, chunk: list[PlaceLine], rows: PartReader, images: PartReader) -> None:
        """Places with all that belongs to them, in one COMMIT behind their descriptors."""
        if not chunk:
            return
        kept = np.frombuffer(rows.read(len(chunk) * self.layout.frame.itemsize), self.layout.frame)
        self._check_descriptors(kept, chunk, rows.name)
        records = self.layout.sealed(kept, self.rows)
        descriptors.append(self.folder, self.layout, self.rows, records)
        checksums: list[int] = records["checksum"].tolist()
        self.connection.execute("BEGIN IMMEDIATE")
        for row, (line, checksum) in enumerate(zip(chunk, checksums, strict=True), start=self.rows):
            self._insert(line, row, checksum, images)
        seals.seal(self.connection, "places", "row >= ?", self.rows)
        name_appended(self.connection, self.layout, self.rows, checksums)
        self.connection.execute("COMMIT")
        self.rows += len(chunk)
        self.advance(self.rows, self.archive.manifest.places)

    def _check_descriptors(self, kept: NDArray[np.void], chunk: list[PlaceLine], name: str) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            vectors = self.layout.descriptors_of(kept)
            largest = np.abs(vectors).max(axis=1)
        for line, value in zip(chunk, largest.tolist(), strict=True):
            if not 0 < value <= LARGEST_HALF:  # not so of what is no number, either
                raise InvalidArchive(f"{name}: the descriptor of place {line.id!r} is none that can be compared.")

    def _insert(self, line: PlaceLine, row: int, checksum: int, images: PartReader) -> None:
        code = self.codes.get(line.sequence)
        if code is None:
            raise InvalidArchive(f"The place {line.id!r} is of a sequence that the file does not list.")
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
            "created_at": moment_text(line.created_at),
            "updated_at": moment_text(line.updated_at),
        }
        names, marks = ", ".join(columns), ", ".join("?" * len(columns))
        query = f"INSERT INTO places ({names}) VALUES ({marks})"
        number = self.connection.execute(query, tuple(columns.values())).lastrowid
        if line.picture is not None:
            content = images.read(line.picture.bytes)
            digest = hashlib.sha256(content).digest()
            if digest.hex() != line.picture.sha256:
                raise InvalidArchive(f"The picture of place {line.id!r} does not match its SHA-256.")
            try:
                self.check_picture(content)
            except InvalidImage as error:
                raise InvalidArchive(f"The picture of place {line.id!r} is none: {error}") from None
            self.connection.execute(
                "INSERT INTO pictures (place, digest, bytes) VALUES (?, ?, ?)", (number, digest, content)
            )

    def _check(self) -> None:
        """Is the whole one map?  What a place needs was checked with it."""
        query = (
            "SELECT s.name FROM sequences s LEFT JOIN places p ON p.sequence = s.code GROUP BY s.code"
            " HAVING coalesce(max(p.ordinal), -1) >= s.next_ordinal OR (s.name IS NOT NULL AND count(p.number) = 0)"
        )
        if wrong := self.connection.execute(query).fetchone():
            raise InvalidArchive(f"The sequence {wrong[0]!r} is empty, or its places stand behind its end.")
        for (line,) in self.connection.execute("PRAGMA quick_check").fetchall():
            if line != "ok":
                raise Damage(f"{FILE}: {line}")
        if sum(segment.rows for segment in named_segments(self.connection, self.layout)) != self.rows:
            raise Damage(f"{FILE} does not name the rows that were written")


def _finish(reader: PartReader, part: Part, seen: int) -> None:
    if seen != part.rows:
        raise InvalidArchive(f"{part.name} has {seen} lines, not {part.rows}.")
    reader.finish()
