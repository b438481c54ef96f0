"""The cameras of a map: the masks of their frames, and the intrinsics by which a pose is measured in them."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from typing import TypeVar

from pydantic import BaseModel

from core.disk.files import Damage
from core.errors import InvalidField, UnknownCamera
from core.frames.intrinsics import Intrinsics
from core.frames.masks import Mask
from core.maps.cameras import MOST_CAMERAS, CameraRecord
from core.maps.cameras import Cameras as AnyCameras
from core.maps.stored_fields import moment_text
from core.storage.database import row_checksums
from core.storage.writing import Write

Connected = TypeVar("Connected")
Access = Callable[[], AbstractContextManager[Connected]]


class Cameras(AnyCameras):
    """All cameras of one map (:class:`core.maps.cameras.Cameras`).

    They are few and needed by every frame, so they stay in memory.  Any thread may use it.
    Every method may raise what ``reading`` and ``writing`` raise.

    Args:
        reading: opens a connection to the map's database.
        writing: begins a write to the map, which is committed at its end.
    """

    def __init__(self, reading: Access[sqlite3.Connection], writing: Access[Write]) -> None:
        self._reading, self._writing = reading, writing
        self._known: dict[str, CameraRecord] | None = None
        self._changes = 0  # counts changes, so that a reading that began before a change is not cached
        self._lock = threading.Lock()  # of both; never held while reading or writing, which take other locks

    def all(self) -> list[CameraRecord]:
        """All cameras by name."""
        return sorted(self._records().values(), key=lambda camera: camera.name)

    def known(self, name: str) -> CameraRecord | None:
        return self._records().get(name)

    def put(self, name: str, mask: Mask | None, intrinsics: Intrinsics | None = None) -> tuple[CameraRecord, bool]:
        """Make a camera or replace its mask and its intrinsics, durably; returns the camera and whether it is new.

        Raises:
            InvalidField: the map has too many cameras.
        """
        made = CameraRecord(name=name, mask=mask, intrinsics=intrinsics, updated_at=datetime.now(UTC))
        with self._writing() as write:
            known = _read(write.connection)
            if name not in known and len(known) >= MOST_CAMERAS:
                raise InvalidField(f"A map has at most {MOST_CAMERAS} cameras.")
            write.connection.execute(
                "INSERT OR REPLACE INTO cameras (name, mask, intrinsics, updated_at) VALUES (?, ?, ?, ?)",
                (name, _text(mask), _text(intrinsics), moment_text(made.updated_at)),
            )
            row_checksums.write_checksums(write.connection, "cameras", "name = ?", name)
        self._forget_known()
        return made, name not in known

    def forget(self, name: str) -> None:
        """Delete a camera; its places stay as they are.

        Raises:
            UnknownCamera: the map has none of this name.
        """
        with self._writing() as write:
            if not write.connection.execute("DELETE FROM cameras WHERE name = ?", (name,)).rowcount:
                raise UnknownCamera(f"The map has no camera {name[:80]!r}.")
        self._forget_known()

    def _forget_known(self) -> None:
        with self._lock:
            self._known, self._changes = None, self._changes + 1

    def _records(self) -> dict[str, CameraRecord]:
        with self._lock:
            known, changes = self._known, self._changes
        if known is None:
            with self._reading() as connection:
                known = _read(connection)
            with self._lock:
                if changes == self._changes:
                    self._known = known
        return known


def _read(connection: sqlite3.Connection) -> dict[str, CameraRecord]:
    found = {}
    columns = ", ".join(row_checksums.CHECKED["cameras"])
    for *sealed, seal in connection.execute(f"SELECT {columns}, seal FROM cameras").fetchall():
        name, mask, moment, intrinsics = sealed
        if not row_checksums.is_sound(sealed, seal):
            raise Damage(f"map.sqlite: camera {name!r} does not match its checksum")
        found[name] = CameraRecord(
            name=name,
            mask=None if mask is None else Mask.model_validate_json(mask),
            intrinsics=None if intrinsics is None else Intrinsics.model_validate_json(intrinsics),
            updated_at=moment,
        )
    return found


def _text(value: BaseModel | None) -> str | None:
    return None if value is None else value.model_dump_json()
