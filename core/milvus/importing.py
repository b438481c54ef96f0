"""Making a map of an export file in PostgreSQL and Milvus.

The map is stored unlisted, under a name that no map can have, until all of it is there; the remains after a crash are
removed a while later.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from psycopg import errors as refusals

from core.errors import InvalidArchive, InvalidField
from core.maps.archives.lines import CameraLine, PlaceLine, SequenceLine
from core.maps.cameras import CameraRecord
from core.maps.stored_fields import metadata_text
from core.milvus import ledger
from core.milvus.database import Database
from core.milvus.forms import Form
from core.milvus.ledger import Frame, PlaceEntry
from core.milvus.map import MilvusMap
from core.milvus.writing import Write
from core.places import NO_SEQUENCE, Place
from core.storage.archives.unpacking import Content, Unpacking


class Importing(Unpacking):
    """Fills a new map from a file."""

    def into(self, map_: MilvusMap, database: Database) -> None:
        """Fill an unlisted map without places.

        Raises:
            InvalidArchive: the file is damaged, or its content is not valid for a map.
            StorageFull, StorageFailure: the part stored until then has to be removed.
        """
        self._map, self._database, self._number = map_, database, map_.number
        self._form = Form(map_.record)
        self._codes: dict[str, int] = {}
        self._lost: dict[int, int] = {}
        self.unpack()
        self._check()

    def put_sequences_and_cameras(self, sequences: Iterator[SequenceLine], cameras: Iterator[CameraLine]) -> None:
        with self._database.transaction("import a map") as connection:
            for line in sequences:
                if line.name is not None:
                    if line.name in self._codes:
                        raise InvalidArchive(f"The sequence {line.name!r} is listed twice.")
                    self._codes[line.name] = ledger.new_sequence(connection, self._number, line.name)
                code = NO_SEQUENCE if line.name is None else self._codes[line.name]
                ledger.put_ordinal(connection, self._number, code, line.next_ordinal - 1)
            for camera in cameras:
                record = CameraRecord(**{name: getattr(camera, name) for name in CameraRecord.model_fields})
                query = "INSERT INTO cameras (map, name, record) VALUES (%s, %s, %s) ON CONFLICT DO NOTHING"
                values = (self._number, camera.name, record.model_dump_json())
                if not connection.execute(query, values).rowcount:
                    raise InvalidArchive(f"The camera {camera.name!r} is listed twice.")

    def put_places(self, lines: Sequence[PlaceLine], frames: NDArray[np.void], contents: Iterator[Content]) -> None:
        with self._map.writing() as write:
            for line, frame, content in zip(lines, frames, contents, strict=True):
                descriptor, local = self._form.divided(frame.tobytes())
                picture = write.stored_picture(None if content.picture is None else content.picture[0])
                try:
                    write.put_new(self._entry(write, line), Frame(descriptor, local, content.keypoints, picture))
                except refusals.UniqueViolation:
                    raise InvalidArchive(f"The place {line.id!r} is listed twice.") from None

    def _entry(self, write: Write, line: PlaceLine) -> PlaceEntry:
        try:
            metadata_text(line.metadata)
        except InvalidField as error:
            raise InvalidArchive(f"The place {line.id!r} cannot be stored: {error}") from None
        place = Place(
            **dict(line.fields()),
            id=line.id,
            pose_of=line.pose_of,
            regions=line.regions,
            picture="none" if line.picture is None else line.picture.kind,
            created_at=line.created_at,
            updated_at=line.updated_at,
        )
        code = NO_SEQUENCE if line.sequence is None else self._code(line.sequence, line)
        numbers = write.new_key(), write.state.rows, write.new_key()
        digest, track = bytes.fromhex(line.digest), self._track(write, line)
        return PlaceEntry(*numbers, digest, code, line.ordinal, place, track, line.station)

    def _code(self, name: str, line: PlaceLine) -> int:
        if name not in self._codes:
            raise InvalidArchive(f"The place {line.id!r} is of a sequence that the file does not list.")
        return self._codes[name]

    def _track(self, write: Write, line: PlaceLine) -> int | None:
        """The code of a place's track; one whose sequence is gone gets a code that no sequence will ever have."""
        if line.track is None or isinstance(line.track, str):
            return None if line.track is None else self._code(line.track, line)
        if line.track not in self._lost:
            self._lost[line.track] = ledger.new_code(write.connection, self._number)
        return self._lost[line.track]

    def _check(self) -> None:
        """Check conditions across places; each place was checked by itself."""
        with self._database.reading() as connection:
            wrong = ledger.wrong_sequence(connection, self._number)
        if wrong is not None:
            raise InvalidArchive(f"The sequence {wrong[0]!r} is empty, or its places stand behind its end.")
