"""A run's state as bytes: a checksum of what follows, the length of a JSON header, the header, and the arrays."""

from __future__ import annotations

import json
import struct
import zlib
from typing import Any

import numpy as np

from core.belief.evidence import Sighting
from core.belief.motion import Odometry
from core.belief.odometry import OdometryPose
from core.belief.run import RunState
from core.belief.speeds import SPEEDS
from core.belief.storeys import Storey
from core.belief.view import HEIGHT, WIDTH, View

FORMAT = 4

WHOLE = 255
"""Shares of speeds are stored in units of one over this number, which is finer than they are known."""

_PREFIX = struct.Struct("<II")  # checksum of all that follows it, length of the head


class DamagedRecord(ValueError):
    """The bytes are damaged, or of another format."""


def to_bytes(state: RunState) -> bytes:
    """Serialize a state, in a few kilobytes: 8 bytes for each row, 4 for each probability, 1 for
    each share of a speed."""
    odometry, pose, sighting = state.odometry, state.pose, state.sighting
    head = {
        "format": FORMAT,
        "unknown": state.unknown,
        "frames": state.frames,
        "unrecognized": state.unrecognized,
        "odometry": [odometry.forward, odometry.left, odometry.turn, odometry.variance, odometry.turn_variance],
        "reach": state.reach,
        "places": len(state.rows),
        "speeds": list(state.shares.shape),
        "view": 0 if state.view is None else len(state.view.levels),
        "blind": state.blind,
        "constant": state.constant,
        "pending_reach": state.pending_reach,
        "pose": None if pose is None else [pose.x, pose.y, pose.heading, pose.covariance, pose.origin],
        "sighting": None if sighting is None else [sighting.row, sighting.probability],
        "storey": [state.storey.level, state.storey.height],
    }
    text = json.dumps(head, separators=(",", ":")).encode()
    arrays = [state.rows.astype("<i8"), state.masses.astype("<f4")]
    arrays.append(np.rint(WHOLE * state.shares).astype("u1"))
    if state.view is not None:
        arrays.append(state.view.levels)
    rest = struct.pack("<I", len(text)) + text + b"".join(array.tobytes() for array in arrays)
    return struct.pack("<I", zlib.crc32(rest)) + rest


def from_bytes(data: bytes) -> RunState:
    """Read what :func:`to_bytes` wrote.

    Raises:
        DamagedRecord: the bytes are damaged, or of another format.
    """
    try:
        checksum, length = _PREFIX.unpack_from(data)
        if zlib.crc32(data[4:]) != checksum:
            raise DamagedRecord("the checksum is wrong")
        head: dict[str, Any] = json.loads(data[_PREFIX.size : _PREFIX.size + length])
        if head["format"] != FORMAT:
            raise DamagedRecord(f"it is of format {head['format']}, this version of placerec knows {FORMAT}")
        position = _PREFIX.size + length

        def array(kind: str, count: int) -> Any:
            nonlocal position
            found = np.frombuffer(data, kind, count, position).copy()
            position += found.nbytes
            return found

        rows, masses = array("<i8", head["places"]), array("<f4", head["places"])
        count, speeds = head["speeds"]
        if speeds != len(SPEEDS):
            raise DamagedRecord("the speeds are others")
        shares = array("u1", count * speeds).reshape(count, speeds).astype(np.float32)
        shares /= np.maximum(shares.sum(axis=1, keepdims=True), 1)
        levels = array("u1", head["view"])
        if len(levels) not in (0, WIDTH * HEIGHT):
            raise DamagedRecord("the view has another size")
        return RunState(
            rows.astype(np.int64),
            masses.astype(np.float32),
            head["unknown"],
            head["frames"],
            head["unrecognized"],
            Odometry(*head["odometry"]),
            head["reach"],
            View(levels) if len(levels) else None,
            head["blind"],
            head["constant"],
            head["pending_reach"],
            _pose(head["pose"]),
            shares,
            None if head["sighting"] is None else Sighting(*head["sighting"]),
            Storey(*head["storey"]),
        )
    except (struct.error, ValueError, KeyError, TypeError) as error:
        raise DamagedRecord(str(error)) from error


def _pose(fields: Any) -> OdometryPose | None:
    if fields is None:
        return None
    x, y, heading, covariance, origin = fields
    return OdometryPose(x, y, heading, None if covariance is None else tuple(covariance), origin)
