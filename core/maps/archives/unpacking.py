"""Reading an export file part by part, with every value checked, for a store that makes a map of it.

The file holds lines of text and never a database: every value is checked and written by our own statements.  So an
export file can bring nothing but values.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidArchive, InvalidImage, InvalidKeypoints
from core.geometry.keypoints import MOST_STORED, keypoints_of, record_bytes
from core.maps.archives.lines import MOST_PICTURE_BYTES, CameraLine, Kind, LabelLine, PlaceLine, SequenceLine, read_line
from core.maps.archives.manifest import ArchivePart, Manifest
from core.maps.archives.reading import Archive, PartReader
from core.maps.cameras import MOST_CAMERAS
from core.maps.enrolling import LARGEST_HALF, CheckDescriptors, any_descriptors
from core.maps.forms import Form, unpack_descriptors

CHUNK_BYTES = 16 << 20
"""Bytes of descriptors that are written, synced and committed together."""

TEXT_BYTES = 2 << 20
"""Bytes of lines that are committed together; parsed, they take many times as much memory."""

MOST_PLACE_BYTES = 1 << 30
"""Most bytes of one descriptor with its local descriptors, as float32."""

MOST_LABELS = 10_000
"""Labelled frames of a map at most: as many as its setting allows it to keep for review."""

LINES_BETWEEN = 1024
"""``advance``, which may end the work, is called after this number of lines of sequences."""

Advance = Callable[[int, int], None]
"""Called with the number of places done and of all; its exceptions end the work."""

CheckPicture = Callable[[bytes], None]
"""Raises InvalidImage for bytes that must not be shown as a picture."""


def form_of(manifest: Manifest) -> Form:
    """The stored form of the descriptors in an export file.

    Raises:
        InvalidArchive: it is impossible.
    """
    record = manifest.map
    if 4 * record.dimension + record.local_cells * record.local_values > MOST_PLACE_BYTES:  # too large for numpy
        raise InvalidArchive(f"The manifest is impossible: a place has more than {MOST_PLACE_BYTES} bytes.")
    try:
        return Form(record.precision, record.dimension, record.local_shape)
    except ValueError as error:
        raise InvalidArchive(f"The manifest is impossible: {error}.") from None


def check_sizes(manifest: Manifest) -> None:
    """Check that the parts of descriptors and keypoints have a size that their places may need.

    Raises:
        InvalidArchive.
    """
    width = form_of(manifest).frame.itemsize
    for number in range(manifest.groups):
        _, part, _, keypoints = manifest.group(number)
        if part.bytes != part.rows * width:
            raise InvalidArchive(f"{part.name} has {part.bytes} bytes, not {part.rows} times {width} bytes.")
        if keypoints.bytes > keypoints.rows * record_bytes(MOST_STORED):
            raise InvalidArchive(f"{keypoints.name} has more bytes than the keypoints of {keypoints.rows} places.")


class Content(NamedTuple):
    """The stored picture and keypoints of a place's frame.

    picture: its bytes and their SHA-256; None: none is stored.
    keypoints: the record of its keypoints; None: none are stored.
    """

    picture: tuple[bytes, bytes] | None
    keypoints: bytes | None


class Unpacking(ABC):
    """Reads a file, and has its content stored; used for one file.

    Args:
        most_picture_bytes: a larger picture is refused before it is read.
        check_descriptors: says which descriptors the map's encoder can have given.
    """

    def __init__(
        self,
        archive: Archive,
        advance: Advance = lambda _done, _all: None,
        check_picture: CheckPicture = lambda _content: None,
        most_picture_bytes: int = MOST_PICTURE_BYTES,
        check_descriptors: CheckDescriptors = any_descriptors,
    ) -> None:
        self._can_be_given = check_descriptors
        self.archive, self.form, self.advance = archive, form_of(archive.manifest), advance
        self._check_picture, self._most_picture_bytes = check_picture, most_picture_bytes
        self.rows = 0
        """Places and looks that are stored."""

    @abstractmethod
    def put_sequences_and_cameras(self, sequences: Iterator[SequenceLine], cameras: Iterator[CameraLine]) -> None:
        """Store all sequences, then all cameras; each iterator is used up."""

    @abstractmethod
    def put_label(self, line: LabelLine, picture: bytes) -> None:
        """Store a labelled frame of the review."""

    @abstractmethod
    def put_places(self, lines: Sequence[PlaceLine], frames: NDArray[np.void], contents: Iterator[Content]) -> None:
        """Store some places whole, or none of them.

        Args:
            frames: their descriptors as they are stored (:attr:`core.maps.forms.Form.frame`), in their order.
            contents: of their frames, in their order; each is read when it is needed.
        """

    def unpack(self) -> None:
        """Read the whole file.

        Raises:
            InvalidArchive: it is damaged, or holds what no map may hold.
            Others: the exceptions of storing.
        """
        manifest = self.archive.manifest
        sequences, cameras = manifest.parts[:2]
        self.put_sequences_and_cameras(self._sequences(sequences), self._cameras(cameras))
        if manifest.labels:
            self._labels(*manifest.labels)
        for number in range(manifest.groups):
            self._group(*manifest.group(number))
        self.archive.check_end()

    def _sequences(self, part: ArchivePart) -> Iterator[SequenceLine]:
        places = self.archive.manifest.places
        if part.rows > places + 1:
            raise InvalidArchive(f"{part.name}: {places} places are in no more than {places + 1} sequences.")
        reader = self.archive.part(part)
        for number, (line, _) in enumerate(_lines(reader, part, SequenceLine), start=1):
            if number % LINES_BETWEEN == 0:
                self.advance(0, places)
            yield line
        reader.finish()

    def _cameras(self, part: ArchivePart) -> Iterator[CameraLine]:
        if part.rows > MOST_CAMERAS:
            raise InvalidArchive(f"{part.name}: a map has at most {MOST_CAMERAS} cameras.")
        reader = self.archive.part(part)
        for line, _ in _lines(reader, part, CameraLine):
            yield line
        reader.finish()

    def _labels(self, part: ArchivePart, files: ArchivePart) -> None:
        if part.rows > MOST_LABELS:
            raise InvalidArchive(f"{part.name}: a map has at most {MOST_LABELS} labelled frames.")
        reader, pictures = self.archive.part(part), self.archive.part(files)
        for line, _ in _lines(reader, part, LabelLine):
            self.put_label(line, self._checked(f"the labelled frame of {line.at}", line.bytes, line.sha256, pictures))
            self.advance(0, self.archive.manifest.places)
        reader.finish()
        pictures.finish()

    def _group(self, places: ArchivePart, *more: ArchivePart) -> None:
        lines, *others = (self.archive.part(part) for part in (places, *more))
        step = max(1, CHUNK_BYTES // self.form.frame.itemsize)
        chunk: list[PlaceLine] = []
        held = 0
        for line, size in _lines(lines, places, PlaceLine):
            chunk.append(line)
            held += size
            if len(chunk) == step or held >= TEXT_BYTES:
                self._store(chunk, *others)
                chunk, held = [], 0
        self._store(chunk, *others)
        for reader in (lines, *others):
            reader.finish()

    def _store(self, chunk: list[PlaceLine], rows: PartReader, images: PartReader, records: PartReader) -> None:
        if not chunk:
            return
        frames = np.frombuffer(rows.read(len(chunk) * self.form.frame.itemsize), self.form.frame)
        self._check_descriptors(frames, chunk, rows.name)
        self.put_places(chunk, frames, (self._content(line, images, records) for line in chunk))
        self.rows += len(chunk)
        self.advance(self.rows, self.archive.manifest.places)

    def _check_descriptors(self, frames: NDArray[np.void], chunk: list[PlaceLine], name: str) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            vectors = unpack_descriptors(frames["descriptor"], self.form.precision, self.form.dimension)
            largest = np.abs(vectors).max(axis=1)
        for line, value in zip(chunk, largest.tolist(), strict=True):
            if not 0 < value <= LARGEST_HALF:  # this is also false for NaN
                raise InvalidArchive(f"{name}: the descriptor of place {line.id!r} cannot be compared.")
        for line, can in zip(chunk, self._can_be_given(vectors).tolist(), strict=True):
            if not can:
                raise InvalidArchive(
                    f"{name}: the descriptor of place {line.id!r} has a length that its encoder gives to none."
                )

    def _content(self, line: PlaceLine, images: PartReader, records: PartReader) -> Content:
        return Content(self._picture(line, images), self._keypoints(line, records))

    def _picture(self, line: PlaceLine, images: PartReader) -> tuple[bytes, bytes] | None:
        if line.picture is None:
            return None
        content = self._checked(f"place {line.id!r}", line.picture.bytes, line.picture.sha256, images)
        return content, bytes.fromhex(line.picture.sha256)

    def _checked(self, of: str, size: int, sha256: str, images: PartReader) -> bytes:
        """The next picture, if it may be stored."""
        if size > self._most_picture_bytes:
            more = f"it has {size} bytes of at most {self._most_picture_bytes}"
            raise InvalidArchive(f"The picture of {of} cannot be taken: {more}.")
        content = images.read(size)
        if hashlib.sha256(content).hexdigest() != sha256:
            raise InvalidArchive(f"The picture of {of} does not match its SHA-256.")
        try:
            self._check_picture(content)
        except InvalidImage as error:
            raise InvalidArchive(f"The picture of {of} cannot be taken: {error}") from None
        return content

    def _keypoints(self, line: PlaceLine, records: PartReader) -> bytes | None:
        if line.keypoints is None:
            return None
        record = records.read(record_bytes(line.keypoints))
        try:
            keypoints_of(record)
        except InvalidKeypoints as error:
            raise InvalidArchive(f"The keypoints of place {line.id!r} cannot be taken: {error}") from None
        return record


def _lines(reader: PartReader, part: ArchivePart, kind: type[Kind]) -> Iterator[tuple[Kind, int]]:
    """The lines of a part, as many as the manifest says, each with the length of its text."""
    seen = 0
    for text in reader.lines():
        seen += 1
        if seen > part.rows:
            raise InvalidArchive(f"{part.name} has more lines, not {part.rows}.")
        yield read_line(text, kind, f"{part.name}, line {seen}"), len(text)
    if seen != part.rows:
        raise InvalidArchive(f"{part.name} has {seen} lines, not {part.rows}.")
