"""The cameras of a map in PostgreSQL."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from typing import Any

from psycopg import Connection

from core.errors import InvalidField, UnknownCamera
from core.frames.intrinsics import Intrinsics
from core.frames.masks import Mask
from core.maps.cameras import MOST_CAMERAS, CameraRecord, Cameras
from core.milvus.ledger import is_storable

Access = Callable[[], AbstractContextManager[Connection[Any]]]


class MilvusCameras(Cameras):
    """All cameras of one map (:class:`core.maps.cameras.Cameras`).  Any thread may use it.

    Args:
        map_number: of the map.
        reading, writing: begin a transaction that reads the map, and one that has locked it.
    """

    def __init__(self, map_number: int, reading: Access, writing: Access) -> None:
        self._map, self._reading, self._writing = map_number, reading, writing

    def all(self) -> list[CameraRecord]:
        """All cameras by name."""
        with self._reading() as connection:
            found = connection.execute("SELECT record FROM cameras WHERE map = %s ORDER BY name", (self._map,))
            return [CameraRecord.model_validate_json(text) for (text,) in found]

    def known(self, name: str) -> CameraRecord | None:
        if not is_storable(name):
            return None
        with self._reading() as connection:
            query = "SELECT record FROM cameras WHERE map = %s AND name = %s"
            found = connection.execute(query, (self._map, name)).fetchone()
        return None if found is None else CameraRecord.model_validate_json(found[0])

    def put(self, name: str, mask: Mask | None, intrinsics: Intrinsics | None = None) -> tuple[CameraRecord, bool]:
        """Make a camera or replace its mask and its intrinsics, durably; returns the camera and whether it is new.

        Raises:
            InvalidField: the map has too many cameras.
        """
        made = CameraRecord(name=name, mask=mask, intrinsics=intrinsics, updated_at=datetime.now(UTC))
        with self._writing() as connection:
            known = {known for (known,) in connection.execute("SELECT name FROM cameras WHERE map = %s", (self._map,))}
            if name not in known and len(known) >= MOST_CAMERAS:
                raise InvalidField(f"A map has at most {MOST_CAMERAS} cameras.")
            query = (
                "INSERT INTO cameras (map, name, record) VALUES (%s, %s, %s)"
                " ON CONFLICT (map, name) DO UPDATE SET record = excluded.record"
            )
            connection.execute(query, (self._map, name, made.model_dump_json()))
            self._count(connection)
        return made, name not in known

    def forget(self, name: str) -> None:
        """Delete a camera; its places stay as they are.

        Raises:
            UnknownCamera: the map has none of this name.
        """
        with self._writing() as connection:
            query = "DELETE FROM cameras WHERE map = %s AND name = %s"
            if not connection.execute(query, (self._map, name)).rowcount:
                raise UnknownCamera(f"The map has no camera {name[:80]!r}.")
            self._count(connection)

    def _count(self, connection: Connection[Any]) -> None:
        """Count the write, so that others notice it."""
        connection.execute("UPDATE maps SET writes = writes + 1, touched = now() WHERE number = %s", (self._map,))
