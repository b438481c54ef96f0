"""The checks of every store before a frame is enrolled, and the picture of it that is stored."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from core.errors import NoRegions
from core.maps.records import Enrolment, Keep
from core.places import check_address

LARGEST_HALF = 65504.0
"""The largest number in half precision."""

CheckDescriptors = Callable[[NDArray[np.float32]], NDArray[np.bool_]]
"""Says which of some descriptors, float32 [n, D], an encoder can have given: bool [n]."""


Reject = Callable[[int, Exception], None]
"""Is called with the position of an item of many and the reason why it is not taken; it may raise, to refuse all."""


def refuse_all(_position: int, error: Exception) -> None:
    """Refuse all items because of one."""
    raise error


def any_descriptors(descriptors: NDArray[np.float32]) -> NDArray[np.bool_]:
    """All descriptors, float32 [n, D], taken as they are: bool [n]."""
    return np.ones(len(descriptors), np.bool_)


def check_enrolment(item: Enrolment, dimension: int, local_shape: tuple[int, int]) -> None:
    """Raise an error for a frame that a map cannot store.

    Args:
        dimension, local_shape: of the map's descriptors, D and (C, L).

    Raises:
        InvalidIdentifier: the id is malformed.
        NoRegions: the descriptor is all zero.
        ValueError: descriptors or a digest of the wrong kind, which is a programming error.
    """
    check_address(item.id)
    descriptor = item.descriptor
    if descriptor.dtype != np.float32 or descriptor.shape != (dimension,):
        raise ValueError(f"a descriptor of this map is float32 [{dimension}]")
    if item.local.dtype != np.int8 or item.local.shape != local_shape:
        raise ValueError(f"the local descriptors of a frame of this map are int8 {list(local_shape)}")
    with np.errstate(over="ignore"):
        squares = float(np.dot(descriptor, descriptor))
    if not np.isfinite(squares):
        raise ValueError("a descriptor is finite")
    if np.abs(descriptor).max() > LARGEST_HALF:
        raise ValueError(f"the values of a descriptor are within ±{LARGEST_HALF:.0f}")
    if squares == 0:
        raise NoRegions(f"The frame for place {item.id!r} has no region of interest, so it cannot be enrolled.")
    if len(item.digest) != 32:
        raise ValueError("a digest is the 32 bytes of SHA-256")
    if item.regions < 0:
        raise ValueError("the number of regions is not negative")


def picture_of(item: Enrolment, keep: Keep) -> tuple[Keep, bytes | None]:
    """The kind of picture that is stored of a frame, and its bytes."""
    if keep == "image" and item.image is not None:
        return keep, item.image
    if keep != "none" and item.thumbnail is not None:
        return "thumbnail", item.thumbnail
    return "none", None
