"""Writing the file of a map from its content in a store at one moment.

The store is read twice: first the lines, for the sizes of all parts, from which it follows how long the file will be
and where each part lies; then everything, to write it.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO, Protocol

from core.disk.permissions import open_private
from core.errors import StorageFailure
from core.maps.archives.manifest import (
    CAMERAS,
    FORMAT,
    LABELLED,
    LABELS,
    MANIFEST,
    MOST_MANIFEST_BYTES,
    SEAL,
    SEQUENCES,
    VERSION,
    WITHOUT_LABELS,
    ArchivedRecord,
    ArchivePart,
    Manifest,
    group_names,
    seal_of,
    tag_of,
    written,
)
from core.maps.archives.tar_layout import BLOCK, END_BYTES, TarLayout, header, padded

PLACES_PER_GROUP = 1024
BYTES_PER_GROUP = 256 << 20
"""A group is also full with this number of bytes of pictures or of descriptors."""

Advance = Callable[[int], None]
"""Called with the number of places that were written; its exceptions end the work."""

Expect = Callable[[int], None]
"""Called with the size of the file in bytes before it is made; its exceptions end the work."""

Chunks = Iterable[bytes | memoryview]


@dataclass(frozen=True)
class Exported:
    """An export file.

    tag: the SHA-256 of its manifest, which identifies all bytes of the file.
    size: in bytes.
    """

    path: Path
    manifest: Manifest
    tag: str
    size: int


@dataclass(frozen=True, slots=True)
class ArchivedPlace:
    """The line of a place, and how much its picture and its keypoints take.

    text: the line.
    number, row: of the place and its descriptor in the store.
    picture_bytes: size of the stored picture of its frame; 0 without one.
    keypoints_bytes: size of the record of its keypoints; 0 without one.
    """

    id: str
    text: bytes
    number: int
    row: int
    picture_bytes: int
    keypoints_bytes: int


@dataclass(frozen=True, slots=True)
class ArchivedLabel:
    """The line of a labelled frame, its number in the store, and the size of its file in bytes."""

    text: bytes
    number: int
    size: int


class ArchiveSource(Protocol):
    """The content of a map at one moment; every method may raise StorageFailure and UnknownMap."""

    @property
    def record(self) -> ArchivedRecord:
        """The map's record."""

    @property
    def frame_bytes(self) -> int:
        """The size of one place's descriptors, as the map stores them."""

    def sequence_lines(self) -> Iterator[bytes]:
        """The lines of sequences by name; that of places without a sequence comes first."""

    def camera_lines(self) -> Iterator[bytes]:
        """The lines of cameras by name."""

    @property
    def labels(self) -> Sequence[ArchivedLabel]:
        """The labelled frames of the review that can be read, oldest first."""

    def labelled(self) -> Chunks:
        """The files of these frames, in their order."""

    def places(self) -> Iterator[ArchivedPlace]:
        """All places in the order of their enrolment."""

    def frames(self, group: Sequence[ArchivedPlace]) -> Chunks:
        """The descriptors of places as they are stored, in their order."""

    def pictures(self, group: Sequence[ArchivedPlace]) -> Chunks:
        """The pictures of those of the places that keep one."""

    def keypoints(self, group: Sequence[ArchivedPlace]) -> Chunks:
        """The records of keypoints of those of the places that have them."""

    @property
    def expect_there(self) -> Callable[[], object]:
        """Raises if the map is gone."""


def write_archive(source: ArchiveSource, path: Path, advance: Advance, expect: Expect) -> Exported:
    """Write a map as a new file, which a crash may lose; nothing is left if this raises.

    Raises:
        StorageFailure: the map is too large for one file.
        OSError: the disk refuses.
        Others: the exceptions of the source.
    """
    manifest = _planned(source)
    tape = TarLayout(manifest, len(written(manifest)))
    expect(tape.size)
    file = os.fdopen(open_private(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "wb")
    try:
        with file:
            return _write(file, path, source, manifest, tape, advance)
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _planned(source: ArchiveSource) -> Manifest:
    """The manifest of the file with the sizes of all parts, without their SHA-256.

    Raises:
        StorageFailure: it would be too long for an import.
    """
    parts = []
    for name, lines in ((SEQUENCES, source.sequence_lines()), (CAMERAS, source.camera_lines())):
        sizes = [len(line) for line in lines]
        parts.append(_unread(name, len(sizes), sum(sizes)))
    places, labels = 0, source.labels
    if labels:
        parts.append(_unread(LABELS, len(labels), sum(len(label.text) for label in labels)))
        parts.append(_unread(LABELLED, len(labels), sum(label.size for label in labels)))
    first = len(parts)
    for rows, text, pictures, records in _grouped(source):
        sizes = [text, rows * source.frame_bytes, pictures, records]
        names = group_names((len(parts) - first) // len(sizes))
        parts += [_unread(name, rows, size) for name, size in zip(names, sizes, strict=True)]
        places += rows
    version = VERSION if labels else WITHOUT_LABELS
    manifest = Manifest(format=FORMAT, version=version, map=source.record, places=places, parts=parts)
    if len(written(manifest)) > MOST_MANIFEST_BYTES:
        more = f"{len(parts)} parts, which no import takes"
        raise StorageFailure(f"The map has too many places for one file: {more}.")
    return manifest


def _grouped(source: ArchiveSource) -> Iterator[tuple[int, int, int, int]]:
    """Of each group its places, and the bytes of its lines, pictures and keypoints."""
    most = max(1, min(PLACES_PER_GROUP, BYTES_PER_GROUP // source.frame_bytes))
    rows = text = pictures = records = 0
    for place in source.places():
        if rows == most or (rows and pictures + place.picture_bytes > BYTES_PER_GROUP):
            yield rows, text, pictures, records
            source.expect_there()
            rows = text = pictures = records = 0
        rows, text = rows + 1, text + len(place.text)
        pictures, records = pictures + place.picture_bytes, records + place.keypoints_bytes
    if rows:
        yield rows, text, pictures, records


def _write(
    file: BinaryIO, path: Path, source: ArchiveSource, planned: Manifest, tape: TarLayout, advance: Advance
) -> Exported:
    file.seek(tape.members[2].start - BLOCK)  # the manifest comes last, when it is known
    sequences, cameras = planned.parts[:2]
    parts = [
        _write_part(file, sequences, source.sequence_lines()),
        _write_part(file, cameras, source.camera_lines()),
    ]
    if planned.labels:
        lines, files = planned.labels
        parts.append(_write_part(file, lines, (label.text for label in source.labels)))
        parts.append(_write_part(file, files, source.labelled()))
    every, done = source.places(), 0
    for number in range(planned.groups):
        places, frames, pictures, records = planned.group(number)
        group = list(islice(every, places.rows))
        parts += [
            _write_part(file, places, (place.text for place in group)),
            _write_part(file, frames, source.frames(group)),
            _write_part(file, pictures, source.pictures(group)),
            _write_part(file, records, source.keypoints(group)),
        ]
        done += len(group)
        advance(done)
    file.write(bytes(END_BYTES))
    manifest = planned.model_copy(update={"parts": parts})
    text = written(manifest)
    file.seek(0)
    for name, data in ((MANIFEST, text), (SEAL, seal_of(text))):
        file.write(header(name, len(data)) + data.ljust(padded(len(data)), b"\0"))
    return Exported(path, manifest, tag_of(text), tape.size)


def _unread(name: str, rows: int, size: int) -> ArchivePart:
    return ArchivePart(name=name, rows=rows, bytes=size, sha256="0" * 64)


def _write_part(file: BinaryIO, part: ArchivePart, chunks: Chunks) -> ArchivePart:
    """Write a part with its header; return it with its SHA-256."""
    file.write(header(part.name, part.bytes))
    digest, size = hashlib.sha256(), 0
    for chunk in chunks:
        file.write(chunk)
        digest.update(chunk)
        size += len(chunk)
    assert size == part.bytes, f"{part.name} has another size than a moment before, in one transaction"
    file.write(bytes(padded(size) - size))
    return part.model_copy(update={"sha256": digest.hexdigest()})
