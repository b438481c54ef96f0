"""Made-up frames whose descriptors follow from their names, so that any process can make them again."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.geometry.keypoints import LENGTH, SHARES, Keypoints
from core.maps import Enrolment
from core.places import PlaceFields, Pose

ENCODER = "made-up@" + "0" * 64
DIMENSION = 16
LOCAL_SHAPE = (3, 5)
"""An odd number of bytes, so that nothing behind them in a record lies where a processor would want it."""


def stored_of(name: str, dimension: int = 16) -> NDArray[np.float32]:
    """What a map made today keeps of :func:`descriptor_of`."""
    return descriptor_of(name, dimension).astype(np.float16).astype(np.float32)


def descriptor_of(name: str, dimension: int = DIMENSION) -> NDArray[np.float32]:
    """A unit vector, float32 [dimension]."""
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    vector = np.random.default_rng(seed).standard_normal(dimension, dtype=np.float32)
    return np.asarray(vector / np.linalg.norm(vector), dtype=np.float32)


def local_of(name: str, shape: tuple[int, int] = LOCAL_SHAPE) -> NDArray[np.int8]:
    """Local descriptors, int8 [C, L] of any values."""
    seed = int.from_bytes(hashlib.sha256(f"local of {name}".encode()).digest()[:8], "big")
    return np.random.default_rng(seed).integers(-128, 128, shape, dtype=np.int8)


def keypoints_of(name: str) -> Keypoints:
    """One to four keypoints."""
    seed = int.from_bytes(hashlib.sha256(f"keypoints of {name}".encode()).digest()[:8], "big")
    random = np.random.default_rng(seed)
    count = int(random.integers(1, 5))
    positions = random.integers(0, SHARES, (count, 2), dtype=np.uint16)
    return Keypoints(640, 480, positions, random.integers(1, 128, (count, LENGTH), dtype=np.int8))


def digest_of(name: str) -> bytes:
    """SHA-256 of the image's bytes, for which the name stands."""
    return hashlib.sha256(f"image of {name}".encode()).digest()


def frame(
    place_id: str,
    picture: str | None = None,
    *,
    dimension: int = DIMENSION,
    local_shape: tuple[int, int] = LOCAL_SHAPE,
    x: float | None = None,
    **fields: Any,
) -> Enrolment:
    """An enrolment of ``place_id`` that shows ``picture`` (by default the place's own)."""
    shown = picture or place_id
    pose = None if x is None else Pose(x=x, y=0.0)
    return Enrolment(
        id=place_id,
        fields=PlaceFields(pose=pose, **fields),
        descriptor=descriptor_of(shown, dimension),
        local=local_of(shown, local_shape),
        regions=len(shown),
        digest=digest_of(shown),
        thumbnail=f"thumbnail of {shown}".encode(),
        image=f"image of {shown}".encode(),
        keypoints=keypoints_of(shown),
    )
