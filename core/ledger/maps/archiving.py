"""Exporting a map: its state of one moment, read in one transaction, which holds up no writes, as one file."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path

from sqlalchemy import bindparam, select

from core.disk.files import disk_errors
from core.errors import StorageFailure, UnknownFrame
from core.geometry.keypoints import count_of
from core.ledger.maps import cameras, frames, places, rows, sequences
from core.ledger.maps.cameras import read_cameras
from core.ledger.maps.checksums import DamagedRow
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.places import StoredPlace
from core.ledger.maps.record import MapState
from core.ledger.maps.review import Review
from core.ledger.maps.schema import SEQUENCES
from core.ledger.statements import Statement
from core.maps.archives.lines import AnswerLine, written_line
from core.maps.archives.manifest import MOST_PART_BYTES, ArchivedRecord
from core.maps.archives.writing import (
    Advance,
    ArchivedLabel,
    ArchivedPlace,
    Expect,
    Exported,
    write_archive,
)
from core.maps.forms import Form
from core.maps.records import MapRecord
from core.maps.review import ReviewFrame
from core.maps.stored_fields import POSE_VALUES, moment_text
from core.places import Pose

AT_ONCE = 64
"""Places whose pictures, keypoints or descriptors are in memory at a time."""

LINES_AT_ONCE = 1024

log = logging.getLogger(__name__)

_NAMES = Statement(
    select(SEQUENCES.c.code, SEQUENCES.c.name).where(SEQUENCES.c.map == bindparam("map"), SEQUENCES.c.name.is_not(None))
)


class Exporter:
    """Writes export files of one map.  Any thread may use it.

    Args:
        viewing: begins a transaction that reads the map, whose state comes with it; raises if the map is gone.
        state: a value that is the same as long as nothing is written to the map.
        review: the frames of the map that are stored for review.
        expect_there: raises if the map is closed or deleted meanwhile.
    """

    def __init__(
        self,
        viewing: Callable[[], AbstractContextManager[tuple[MapConnection, MapState]]],
        state: Callable[[], object],
        review: Review,
        expect_there: Callable[[], object],
    ) -> None:
        self._viewing, self._state, self._review, self._expect_there = viewing, state, review, expect_there

    def state(self) -> object:
        """A value that is the same as long as nothing is written to the map, and no frame of the review labelled."""
        return self._state(), self._review.labels_state()

    def write(
        self, path: Path, advance: Advance = lambda _written: None, expect: Expect = lambda _size: None
    ) -> Exported:
        """Write the present state of the map as a new file, which a crash may lose; nothing is left if this raises.

        Every row and every value is compared with its checksum.

        Raises:
            UnknownMap, MapQuarantined: the map was deleted meanwhile, or is damaged.
            StorageFull, StorageFailure.
        """
        with disk_errors("write the map as a file"), self._viewing() as (connection, state):
            for table, names in (("places", places.unsound(connection)), ("cameras", cameras.unsound(connection))):
                if names:
                    raise DamagedRow(f"{names[0]!r} of {table} does not match its checksum")
            return write_archive(
                _Source(connection, state.record, self._review, self._expect_there), path, advance, expect
            )


class _Source:
    """A map as it is in one transaction (:class:`core.maps.archives.writing.ArchiveSource`)."""

    def __init__(
        self, connection: MapConnection, record: MapRecord, review: Review, expect_there: Callable[[], object]
    ) -> None:
        self.connection, self._review, self.expect_there = connection, review, expect_there
        self.record = ArchivedRecord.model_validate(record.model_dump())
        self.frame_bytes = Form.of(record).frame.itemsize

    def frames(self, group: Sequence[ArchivedPlace]) -> Iterator[bytes]:
        """The descriptors of places as they are stored, in their order."""
        for some in pieces(group):
            numbers = [place.row for place in some]
            descriptors, local = (rows.at(self.connection, kind, numbers) for kind in rows.OF_FRAMES)
            if any(row not in descriptors or row not in local for row in numbers):
                raise DamagedRow("a place has no descriptors")
            yield b"".join(part for row in numbers for part in (descriptors[row], local[row]))
            self.expect_there()

    def sequence_lines(self) -> Iterator[bytes]:
        """The lines of sequences by name; that of places without a sequence comes first."""
        for name, following in sequences.ends(self.connection).items():
            yield written_line({"name": name, "next_ordinal": following})

    def camera_lines(self) -> Iterator[bytes]:
        """The lines of cameras by name."""
        for camera in read_cameras(self.connection).values():
            values = json.loads(camera.model_dump_json(exclude={"name", "updated_at"}))
            if camera.value_range is None:  # which earlier versions do not know
                del values["value_range"]
            yield written_line({"name": camera.name, **values, "updated_at": moment_text(camera.updated_at)})

    @cached_property
    def labels(self) -> Sequence[ArchivedLabel]:
        """The labelled frames of the review that can be read, oldest first; of too many for a part the latest."""
        found: list[ArchivedLabel] = []
        size = 0
        for frame in reversed(self._review.labelled()):
            try:
                length = len(self._review.picture(frame.number))
            except (StorageFailure, UnknownFrame) as error:
                log.warning("a labelled frame of %s is left out of its export: %s", self.record.id, error)
                continue
            if (size := size + length) >= MOST_PART_BYTES:
                log.warning("the older labelled frames of %s do not fit into its export", self.record.id)
                break
            found.append(ArchivedLabel(_label_line(frame), frame.number, length))
        return found[::-1]

    def labelled(self) -> Iterator[bytes]:
        """The files of these frames, in their order."""
        for label in self.labels:
            try:
                yield self._review.picture(label.number)
            except UnknownFrame as error:
                raise StorageFailure("A labelled frame was thrown away meanwhile; export the map again.") from error

    def places(self) -> Iterator[ArchivedPlace]:
        """All places and looks in the order in which they were added."""
        names = dict(self.connection.execute(_NAMES))
        lost: dict[int, int] = {}
        after = -1
        while page := places.listed_with_looks(self.connection, after, LINES_AT_ONCE):
            pictures, records = frames.sizes_at(self.connection, [stored.row for stored in page])
            for stored in page:
                track = None if stored.track is None else names.get(stored.track)
                if stored.track is not None and track is None:
                    track = lost.setdefault(stored.track, len(lost))
                yield _archived(stored, track, pictures.get(stored.row), records.get(stored.row, 0))
            after = page[-1].number

    def pictures(self, group: Sequence[ArchivedPlace]) -> Iterator[bytes]:
        """The pictures of those of the places that keep one."""
        for some in pieces([place for place in group if place.picture_bytes]):
            found = frames.pictures_at(self.connection, [place.row for place in some])
            for place in some:
                if (picture := found.get(place.row)) is None:
                    raise StorageFailure(f"The picture of place {place.id!r} is missing.")
                yield picture

    def keypoints(self, group: Sequence[ArchivedPlace]) -> Iterator[bytes]:
        """The records of keypoints of those of the places that have them."""
        for some in pieces([place for place in group if place.keypoints_bytes]):
            found = frames.records_at(self.connection, [place.row for place in some])
            yield from (found[place.row] for place in some)


def pieces(group: Sequence[ArchivedPlace], size: int = AT_ONCE) -> Iterator[Sequence[ArchivedPlace]]:
    """A group in pieces of at most ``size`` places."""
    for first in range(0, len(group), size):
        yield group[first : first + size]


def _label_line(frame: ReviewFrame) -> bytes:
    """The line of a labelled frame."""
    said = frame.label or {}
    return written_line(
        {
            "at": moment_text(frame.at),
            "bytes": frame.size,
            "sha256": frame.digest.hex(),
            "answer": {name: frame.answer[name] for name in AnswerLine.model_fields if name in frame.answer},
            "label": said["label"],
            "labelled_at": said["at"],
            "labelled_by": said["by"],
        }
    )


def _archived(
    stored: StoredPlace, track: str | int | None, picture: tuple[int, bytes] | None, keypoints: int
) -> ArchivedPlace:
    """The line of a place.

    Args:
        track: the name of its track, or the number of a track whose sequence is gone; None: it has none.
        picture: size and SHA-256.
        keypoints: bytes of their record; 0: it has none.
    """
    place = stored.place
    described = None
    if picture is not None:
        described = {"kind": place.picture, "bytes": picture[0], "sha256": picture[1].hex()}
    text = written_line(
        {
            "id": place.id,
            "pose": _pose(place.pose),
            "pose_of": place.pose_of,
            "timestamp": None if place.timestamp is None else moment_text(place.timestamp),
            "sequence": place.sequence,
            "ordinal": stored.ordinal,
            "track": track,
            "station": stored.station,
            "camera": place.camera,
            "metadata": place.metadata,
            "regions": place.regions,
            "digest": stored.digest.hex(),
            "picture": described,
            "keypoints": count_of(keypoints) if keypoints else None,
            "created_at": moment_text(place.created_at),
            "updated_at": moment_text(place.updated_at),
            "seen": stored.seen,
            "run": stored.run,
            "least": stored.least,
            "level": place.level,
            "pose_accuracy": None if place.pose_accuracy is None else place.pose_accuracy.model_dump(),
        }
    )
    size = 0 if picture is None else picture[0]
    return ArchivedPlace(place.id, text, stored.number, stored.row, size, keypoints)


def _pose(pose: Pose | None) -> dict[str, float] | None:
    if pose is None:
        return None
    return {name: value for name in POSE_VALUES if (value := getattr(pose, name)) is not None}
