"""A run's state as bytes: a checksum of what follows, the length of a JSON header, the header, and the arrays."""

from __future__ import annotations

import json
import struct
import zlib
from typing import Any

import numpy as np

from core.belief.consistency import Contradiction, OdometryCheck, SeenPlace
from core.belief.evidence import Evidence, Sighting
from core.belief.motion import Odometry
from core.belief.odometry import OdometryPose
from core.belief.run import CountedLook, RunState
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
    """Serialize a state, in a few kilobytes: 8 bytes for each row, 4 for each probability or gain, and 1 for each share
    of a speed."""
    pose, sighting = state.pose, state.sighting
    head = {
        "format": FORMAT,
        "unknown": state.unknown,
        "frames": state.frames,
        "unrecognized": state.unrecognized,
        "odometry": _odometry_fields(state.odometry),
        "reach": state.reach,
        "places": len(state.rows),
        "speeds": list(state.shares.shape),
        "view": 0 if state.view is None else len(state.view.levels),
        "blind": state.blind,
        "constant": state.constant,
        "unlike": state.unlike,
        "pending_reach": state.pending_reach,
        "pose": _pose_fields(pose),
        "sighting": None if sighting is None else [sighting.row, sighting.probability],
        "storey": [state.storey.level, state.storey.height, state.storey.last],
        "check": _check_fields(state.check),
        "looks": [
            [len(one.seen.rows), one.seen.unknown, one.share, one.frames, one.constant, one.change]
            for one in state.looks
        ],
    }
    text = json.dumps(head, separators=(",", ":")).encode()
    arrays = [state.rows.astype("<i8"), state.masses.astype("<f4")]
    arrays.append(np.rint(WHOLE * state.shares).astype("u1"))
    if state.view is not None:
        arrays.append(state.view.levels)
    for look in state.looks:
        arrays += [look.seen.rows.astype("<i8"), look.seen.gains.astype("<f4")]
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
            _check(head["check"]),
            tuple(
                CountedLook(Evidence(array("<i8", count), array("<f4", count), unknown), *fields)
                for count, unknown, *fields in head["looks"]
            ),
            head["unlike"],
        )
    except (struct.error, ValueError, KeyError, TypeError) as error:
        raise DamagedRecord(str(error)) from error


def _odometry_fields(odometry: Odometry) -> list[float]:
    return [odometry.forward, odometry.left, odometry.turn, odometry.variance, odometry.turn_variance]


def _pose_fields(pose: OdometryPose | None) -> list[Any] | None:
    return None if pose is None else [pose.x, pose.y, pose.heading, pose.covariance, pose.origin]


def _check_fields(check: OdometryCheck) -> list[Any]:
    found = check.contradiction
    return [
        *([_seen_fields(one) for one in seen] for seen in (check.seen, check.aside)),
        None if check.motion is None else _odometry_fields(check.motion),
        check.path,
        _pose_fields(check.pose),
        None if found is None else [found.kind, found.note],
    ]


def _seen_fields(seen: SeenPlace) -> list[float]:
    points = (seen.offset, seen.leg, seen.by_degrees)
    return [
        seen.row,
        seen.spread,
        seen.variance,
        seen.stated,
        *(part for one in points for part in (one.real, one.imag)),
    ]


def _check(fields: Any) -> OdometryCheck:
    seen, aside, motion, path, pose, found = fields
    return OdometryCheck(
        tuple(_seen(*one) for one in seen),
        tuple(_seen(*one) for one in aside),
        None if motion is None else Odometry(*motion),
        path,
        _pose(pose),
        None if found is None else Contradiction(*found),
    )


def _seen(row: int, spread: float, variance: float, stated: float, *parts: float) -> SeenPlace:
    offset, leg, by_degrees = (complex(*parts[at : at + 2]) for at in (0, 2, 4))
    return SeenPlace(row, offset, spread, leg, by_degrees, variance, stated)


def _pose(fields: Any) -> OdometryPose | None:
    if fields is None:
        return None
    x, y, heading, covariance, origin = fields
    return OdometryPose(x, y, heading, None if covariance is None else tuple(covariance), origin)
