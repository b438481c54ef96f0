"""Exporting a map: keeping its state at one moment in a folder, from which the export file is then read.

The content of the database is copied, including pictures.  Descriptors are not copied: their files only ever grow, so a
hard link to each keeps all rows of that moment, whatever happens to the map.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from core.disk.files import Damage
from core.errors import StorageFailure, UnknownMap
from core.storage.archives.lines import StoredLine, camera_lines, place_lines, sequence_lines
from core.storage.archives.manifest import (
    CAMERAS,
    FORMAT,
    MANIFEST,
    MOST_MANIFEST_BYTES,
    SEQUENCES,
    VERSION,
    ArchivedRecord,
    Manifest,
    Part,
    group_names,
    tag_of,
    written,
)
from core.storage.archives.virtual_archive import ROW, ROWS, LinkedSegments, VirtualArchive
from core.storage.cameras import Access
from core.storage.database import ledger, row_checksums
from core.storage.database.connections import FILE
from core.storage.database.ledger import segment_entries
from core.storage.files.segment_files import Layout, segment_name
from core.storage.opening import OpenMap, read_layout

PLACES_PER_GROUP = 1024
BYTES_PER_GROUP = 256 << 20
"""A group is also full when it has so many bytes of pictures or of descriptors."""

Advance = Callable[[int], None]
"""Is called with the number of places that were read; what it raises ends the work."""


class Exporter:
    """Keeps moments of one map for export.  Any thread may use it.

    Args:
        folder: of the map.
        reading: opens a connection to its database.
        opened: returns the open map, or None.
        guarded: turns errors of the disk in its block into ours, and quarantines the map if it is damaged.
    """

    def __init__(
        self,
        folder: Path,
        reading: Access[sqlite3.Connection],
        opened: Callable[[], OpenMap | None],
        guarded: Callable[[str], AbstractContextManager[None]],
    ) -> None:
        self._folder, self._reading, self._opened, self._guarded = folder, reading, opened, guarded

    def state(self) -> object | None:
        """An object that is the same as long as nothing is written to the map; None while the map is not open."""
        opened = self._opened()
        return None if opened is None else opened.database.state

    def into(self, folder: Path, advance: Advance = lambda _read: None) -> VirtualArchive:
        """Keep the present state of the map in ``folder``, which is made; nothing of it is left if this raises.

        The database is read in one transaction, which does not hold up writes; then the descriptors are read and
        checked once, independently of the map.

        Raises:
            UnknownMap, MapQuarantined: the map was deleted meanwhile, or is damaged.
            StorageFull, StorageFailure.
        """
        try:
            with self._guarded("export"):
                folder.mkdir(parents=True)
                # Deleting the map waits for its readers, so this ends as soon as the map is closed.
                with self._reading() as connection, self._files_kept():
                    taken = self._take(connection, folder, advance)
                return _described(taken, folder, advance)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise

    def _take(self, connection: sqlite3.Connection, folder: Path, advance: Advance) -> _Taken:
        connection.execute("BEGIN")
        try:
            record, layout = read_layout(connection)
            for table in ("places", "cameras"):
                if broken := row_checksums.mismatched(connection, table):
                    raise Damage(f"{FILE}: {broken[0]!r} of {table} does not match its checksum")
            entries = segment_entries(connection, layout)
            for segment in entries:
                if segment.removed:
                    continue
                self._expect_there()
                _link(self._folder / segment_name(segment.number), folder / segment_name(segment.number))
            taken = _Taken(ArchivedRecord.model_validate(record.model_dump()), layout)
            taken.parts.append(_write_lines(folder / SEQUENCES, sequence_lines(connection)))
            taken.parts.append(_write_lines(folder / CAMERAS, camera_lines(connection)))
            with (folder / ROWS).open("wb") as rows:
                for group in self._grouped(connection, layout):
                    taken.groups.append(_write_group(folder, len(taken.groups), connection, group, rows))
                    taken.places += len(group)
                    advance(taken.places)
            return taken
        finally:
            if connection.in_transaction:  # SQLite may have ended it itself; that error is the one to report
                connection.execute("ROLLBACK")

    def _grouped(self, connection: sqlite3.Connection, layout: Layout) -> Iterator[list[StoredLine]]:
        most = max(1, min(PLACES_PER_GROUP, BYTES_PER_GROUP // layout.frame.itemsize))
        group: list[StoredLine] = []
        held = 0
        for line in place_lines(connection):
            if len(group) == most or (group and held + line.picture_bytes > BYTES_PER_GROUP):
                yield group
                self._expect_there()
                group, held = [], 0
            group.append(line)
            held += line.picture_bytes
        if group:
            yield group

    def _files_kept(self) -> AbstractContextManager[None]:
        """No segment file is deleted during the block."""
        opened = self._opened()
        return nullcontext() if opened is None else opened.removed_segments.kept()

    def _expect_there(self) -> None:
        if self._opened() is None:
            raise UnknownMap(f"The map {self._folder.name!r} was deleted or closed while it was read.")


@dataclass
class _Taken:
    """What was read in the transaction.  groups: the parts of places and of pictures of each group."""

    record: ArchivedRecord
    layout: Layout
    places: int = 0
    parts: list[Part] = field(default_factory=list)
    groups: list[tuple[Part, Part]] = field(default_factory=list)


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except FileNotFoundError:
        raise UnknownMap(f"The map {source.parent.name!r} was deleted while it was read.") from None
    except OSError:  # the file system has no hard links, or no more of them
        shutil.copyfile(source, target)


def _write_lines(path: Path, lines: Iterator[bytes]) -> Part:
    digest, rows, size = hashlib.sha256(), 0, 0
    with path.open("wb") as file:
        for line in lines:
            file.write(line)
            digest.update(line)
            rows, size = rows + 1, size + len(line)
    return Part(name=path.name, rows=rows, bytes=size, sha256=digest.hexdigest())


def _write_group(
    folder: Path, number: int, connection: sqlite3.Connection, group: list[StoredLine], rows: BinaryIO
) -> tuple[Part, Part]:
    """Write the lines and pictures of a group, and the rows of its descriptors."""
    places_name, _, pictures_name = group_names(number)
    places = _write_lines(folder / places_name, (line.text for line in group))
    digest, size = hashlib.sha256(), 0
    with (folder / pictures_name).open("wb") as file:
        for line in group:
            if line.picture_bytes:
                content = ledger.picture(connection, line.number, line.id)
                assert content is not None
                file.write(content)
                digest.update(content)
                size += len(content)
    rows.write(np.array([(line.row, line.checksum) for line in group], ROW).tobytes())
    return places, Part(name=pictures_name, rows=len(group), bytes=size, sha256=digest.hexdigest())


def _described(taken: _Taken, folder: Path, advance: Advance) -> VirtualArchive:
    """Read and check all descriptors for their SHA-256, and write the manifest."""
    parts = list(taken.parts)
    links, first = LinkedSegments(folder, taken.layout), 0
    for number, (places, pictures) in enumerate(taken.groups):
        digest, size = hashlib.sha256(), 0
        rows = np.fromfile(folder / ROWS, ROW, places.rows, offset=first * ROW.itemsize)
        for frames in links.chunks(rows):
            content = frames.view(np.uint8).data
            digest.update(content)
            size += len(content)
        first += places.rows
        name = group_names(number)[1]
        parts += [places, Part(name=name, rows=places.rows, bytes=size, sha256=digest.hexdigest()), pictures]
        advance(taken.places)
    manifest = Manifest(format=FORMAT, version=VERSION, map=taken.record, places=taken.places, parts=parts)
    text = written(manifest)
    if len(text) > MOST_MANIFEST_BYTES:
        raise StorageFailure(f"The map has too many places for one file: {len(parts)} parts, which no import takes.")
    (folder / MANIFEST).write_bytes(text)
    return VirtualArchive(folder, manifest, text, tag_of(text), links)
