"""The cameras of a map: the masks of their frames, and the intrinsics by which a pose is measured in them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from datetime import UTC, datetime

from pydantic import BaseModel, TypeAdapter
from sqlalchemy import bindparam, delete, select

from core.errors import InvalidField, UnknownCamera
from core.frames.intrinsics import Intrinsics
from core.frames.masks import Mask, RangedMask, with_range
from core.frames.value_ranges import ValueRange
from core.ledger.maps.checksums import DamagedRow, is_sound, sealed, sealed_columns
from core.ledger.maps.connection import MapConnection, Reading
from core.ledger.maps.schema import CAMERAS
from core.ledger.maps.writing import Write
from core.ledger.statements import Statement
from core.maps.cameras import MOST_CAMERAS, CameraRecord, KnownCameras
from core.maps.stored_fields import moment_text

_C = CAMERAS.c
_STORED: TypeAdapter[RangedMask | Mask] = TypeAdapter(RangedMask | Mask)
"""What the column ``mask`` holds."""
_COLUMNS = sealed_columns(CAMERAS)
_ALL = Statement(select(*(_C[name] for name in _COLUMNS), _C.seal).where(_C.map == bindparam("map")).order_by(_C.name))
_PUT = Statement(
    lambda insert: (
        put := insert(CAMERAS).values({name: bindparam(name) for name in ("map", *_COLUMNS, "seal")})
    ).on_conflict_do_update(
        index_elements=["map", "name"],
        set_={name: put.excluded[name] for name in (*_COLUMNS, "seal") if name != "name"},
    )
)
_DELETE = Statement(delete(CAMERAS).where(_C.map == bindparam("map"), _C.name == bindparam("which")))


class Cameras(KnownCameras):
    """All cameras of one map.

    They are few and needed by every frame, so they are remembered until the map is written to.  Any thread may use it.
    Every method may raise what ``reading`` and ``writing`` raise.

    Args:
        reading, writing: begin a transaction that reads the map, and a write to it.
        state: a value that is the same until the map is written to.
    """

    def __init__(
        self, reading: Reading, writing: Callable[[], AbstractContextManager[Write]], state: Callable[[], object]
    ) -> None:
        self._reading, self._writing, self._state = reading, writing, state
        self._known: tuple[object, dict[str, CameraRecord]] = (object(), {})

    def all(self) -> list[CameraRecord]:
        """All cameras by name."""
        return list(self._records().values())

    def known(self, name: str) -> CameraRecord | None:
        """One camera; None if the map has none of this name."""
        return self._records().get(name)

    def put(
        self,
        name: str,
        mask: Mask | None,
        intrinsics: Intrinsics | None = None,
        value_range: ValueRange | None = None,
    ) -> tuple[CameraRecord, bool]:
        """Make a camera or replace all its settings, durably; returns the camera and whether it is new.

        Raises:
            InvalidField: the map has too many cameras.
        """
        made = CameraRecord(
            name=name, mask=mask, intrinsics=intrinsics, value_range=value_range, updated_at=datetime.now(UTC)
        )
        with self._writing() as write:
            known = read_cameras(write.connection)
            if name not in known and len(known) >= MOST_CAMERAS:
                raise InvalidField(f"A map has at most {MOST_CAMERAS} cameras.")
            put_camera(write.connection, made)
            write.changed = True
        return made, name not in known

    def forget(self, name: str) -> None:
        """Delete a camera; its places stay as they are.

        Raises:
            UnknownCamera: the map has none of this name.
        """
        with self._writing() as write:
            if not write.connection.change(_DELETE, which=name):
                raise UnknownCamera(f"The map has no camera {name[:80]!r}.")
            write.changed = True

    def _records(self) -> dict[str, CameraRecord]:
        state, (of, known) = self._state(), self._known
        if of != state:
            with self._reading() as connection:
                known = read_cameras(connection)
            self._known = state, known
        return known


def put_camera(connection: MapConnection, camera: CameraRecord) -> None:
    """Store a camera, in the place of one of its name."""
    values = {
        "name": camera.name,
        "mask": _text(with_range(camera.mask, camera.value_range)),  # a column of its own would break the seals
        "intrinsics": _text(camera.intrinsics),
        "updated_at": moment_text(camera.updated_at),
    }
    connection.execute(_PUT, **sealed(_COLUMNS, values))


def read_cameras(connection: MapConnection) -> dict[str, CameraRecord]:
    """All cameras by name, in order.

    Raises:
        DamagedRow: the row of one does not match its checksum.
    """
    found = {}
    for *columns, seal in connection.execute(_ALL):
        name, mask, intrinsics, moment = columns
        if not is_sound(columns, seal):
            raise DamagedRow(f"the row of camera {name!r} does not match its checksum")
        known = None if mask is None else _STORED.validate_json(mask)
        ranged = known if isinstance(known, RangedMask) else None
        found[name] = CameraRecord(
            name=name,
            mask=known if ranged is None else ranged.areas(),
            value_range=None if ranged is None else ranged.value_range,
            intrinsics=None if intrinsics is None else Intrinsics.model_validate_json(intrinsics),
            updated_at=moment,
        )
    return found


def unsound(connection: MapConnection) -> list[str]:
    """The names of the cameras whose row does not match its checksum."""
    return [str(columns[0]) for *columns, seal in connection.execute(_ALL) if not is_sound(columns, seal)]


def _text(value: BaseModel | None) -> str | None:
    return None if value is None else value.model_dump_json()
