"""Filling a new map from an export file, whatever keeps it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidArchive, InvalidField
from core.ledger.maps import places, sequences
from core.ledger.maps.cameras import put_camera
from core.ledger.maps.places import StoredPlace
from core.ledger.maps.review import Review
from core.ledger.maps.writing import Write
from core.maps.archives.lines import CameraLine, LabelLine, PlaceLine, SequenceLine
from core.maps.archives.reading import Archive
from core.maps.archives.unpacking import Advance, CheckPicture, Content, Unpacking
from core.maps.cameras import CameraRecord
from core.maps.enrolling import CheckDescriptors, any_descriptors
from core.maps.records import MOST_LOOKS
from core.maps.stored_fields import moment_text
from core.names import LONGEST, composed
from core.places import NO_SEQUENCE, place_and_look

log = logging.getLogger(__name__)


class Importing(Unpacking):
    """Fills a map without places from a file.

    Args:
        writing: begins a write to the map.
        review: where its labelled frames go.
        Others: as of :class:`core.maps.archives.unpacking.Unpacking`.
    """

    def __init__(
        self,
        archive: Archive,
        advance: Advance,
        check_picture: CheckPicture,
        most_picture_bytes: int,
        writing: Callable[[], AbstractContextManager[Write]],
        review: Review,
        check_descriptors: CheckDescriptors = any_descriptors,
    ) -> None:
        super().__init__(archive, advance, check_picture, most_picture_bytes, check_descriptors)
        self._writing, self._review = writing, review
        self.places = 0
        """Places that are stored, their looks apart."""
        self._codes: dict[str, int] = {}  # of sequences, by their names in the file
        self._lost: dict[int, int] = {}  # the codes of the tracks whose sequences are gone, by their numbers there

    def fill(self) -> None:
        """Store all of the file.

        Raises:
            InvalidArchive: the file is damaged, or its content is not valid for a map.
            StorageFull, StorageFailure, OSError, sqlite3.Error: the part stored until then has to be removed.
        """
        self.unpack()
        with self._writing() as write:
            wrong = sequences.wrong(write.connection, 1)
        if wrong:
            raise InvalidArchive(f"The sequence {wrong[0]!r} is empty, or its places stand behind its end.")

    def put_sequences_and_cameras(self, sequence_lines: Iterator[SequenceLine], cameras: Iterator[CameraLine]) -> None:
        with self._writing() as write:
            for line in sequence_lines:
                if line.name is not None:
                    if line.name in self._codes:
                        raise InvalidArchive(f"The sequence {line.name!r} is listed twice.")
                    self._codes[line.name] = sequences.new_sequence(write.connection, self._free(write, line.name))
                code = NO_SEQUENCE if line.name is None else self._codes[line.name]
                sequences.keep_free(write.connection, code, line.next_ordinal)
            seen = set()
            for camera in cameras:
                if camera.name in seen:
                    raise InvalidArchive(f"The camera {camera.name!r} is listed twice.")
                seen.add(camera.name)
                values = {name: getattr(camera, name) for name in CameraRecord.model_fields}
                put_camera(write.connection, CameraRecord(**values))
            write.changed = True

    def _free(self, write: Write, written: str) -> str:
        """The name that a sequence of the file gets: in the one form of texts, and not that of another sequence."""
        wanted = composed(written)
        name, number = wanted, 2
        while sequences.find_code(write.connection, name) is not None:
            name, number = f"{wanted[: LONGEST - 8]}~{number}", number + 1
        if name != written:
            log.warning("sequence renamed", extra={"map": self.archive.manifest.map.id, "before": written, "now": name})
        return name

    def put_label(self, line: LabelLine, picture: bytes) -> None:
        told = line.answer.model_dump(exclude_unset=True)
        answer = {name: value.isoformat() if isinstance(value, datetime) else value for name, value in told.items()}
        said = {
            "label": line.label.model_dump(exclude_defaults=True),
            "at": line.labelled_at.isoformat(),
            "by": line.labelled_by,
        }
        if not self._review.restore(picture, line.at, answer, said):
            raise InvalidArchive("A labelled frame is listed twice.")

    def put_places(self, lines: Sequence[PlaceLine], stored: NDArray[np.void], contents: Iterator[Content]) -> None:
        with self._writing() as write:
            known = places.rows_of(write.connection, [line.id for line in lines])
            for at, (line, content) in enumerate(zip(lines, contents, strict=True)):
                if line.id in known:
                    raise InvalidArchive(f"The place {line.id!r} is listed twice.")
                place = self._place_of_look(write, line)
                known[line.id] = row = write.add_stored(stored[at : at + 1])
                read = self._place(write, line, row)
                made = write.insert(read) if place is None else write.insert_look(place, places.as_look(read, place))
                self.places += place is None
                if content.picture is not None:
                    write.put_picture(row, content.picture[0])
                if content.keypoints is not None:
                    write.put_keypoints(made, content.keypoints)

    def _place_of_look(self, write: Write, line: PlaceLine) -> StoredPlace | None:
        """The place that a look is of; None for the line of a place."""
        place_id, look = place_and_look(line.id)
        if look is None:
            return None
        if (place := write.find(place_id)) is None:
            raise InvalidArchive(f"The look {line.id!r} is of a place that the file does not list before it.")
        if not line.digest.startswith(look):
            raise InvalidArchive(f"The look {line.id!r} is not named by the digest of its frame.")
        if place.digest.hex() == line.digest:
            raise InvalidArchive(f"The look {line.id!r} shows the frame with which its place was enrolled.")
        if place.place.looks >= MOST_LOOKS:
            raise InvalidArchive(f"The place {place_id!r} has more than {MOST_LOOKS} looks.")
        return place

    def _place(self, write: Write, line: PlaceLine, row: int) -> StoredPlace:
        code = NO_SEQUENCE if line.sequence is None else self._code(line.sequence, line)
        try:
            return places.placed(
                line.id, line.fields(), code, line.ordinal, number=write.state.numbers, row=row,
                digest=bytes.fromhex(line.digest), regions=line.regions,
                picture="none" if line.picture is None else line.picture.kind, track=self._track(write, line),
                station=line.station, pose_of=line.pose_of, revision=write.state.revision + 1,
                seen=None if line.seen is None else moment_text(line.seen), run=line.run,
                least=line.least,
                created_at=moment_text(line.created_at), updated_at=moment_text(line.updated_at),
            )  # fmt: skip
        except InvalidField as error:
            raise InvalidArchive(f"The place {line.id!r} cannot be stored: {error}") from None

    def _code(self, name: str, line: PlaceLine) -> int:
        if name not in self._codes:
            raise InvalidArchive(f"The place {line.id!r} is of a sequence that the file does not list.")
        return self._codes[name]

    def _track(self, write: Write, line: PlaceLine) -> int | None:
        """The code of a place's track; one whose sequence is gone gets a code that no sequence will ever have."""
        if line.track is None or isinstance(line.track, str):
            return None if line.track is None else self._code(line.track, line)
        if line.track not in self._lost:
            self._lost[line.track] = sequences.new_code(write.connection)
        return self._lost[line.track]
