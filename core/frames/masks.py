"""Masks: the parts of a camera's frames that never show the place, such as the vehicle or a time stamp."""

from __future__ import annotations

import hashlib
import json
from functools import lru_cache
from typing import Annotated, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, FailFast, Field, model_validator

from core.frames.value_ranges import ValueRange

Coordinate = Annotated[float, Field(strict=True, ge=0, le=1, allow_inf_nan=False)]
Corner = tuple[Coordinate, Coordinate]
Polygon = Annotated[tuple[Corner, ...], Field(min_length=3, max_length=256), FailFast()]

_FINER = 8
"""The covered area of a cell is counted on a grid of this many pixels a side."""

_LEAST_LEFT = 0.1
"""The share of the frame that a mask must leave visible."""


class Mask(BaseModel):
    """The parts of each frame of one camera that are ignored.

    ``polygons`` are given by their corners, (x, y) in shares of the upright frame's width and height,
    from its top left corner; where they overlap, all that any of them holds is covered.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    polygons: Annotated[tuple[Polygon, ...], Field(min_length=1, max_length=64), FailFast()]

    @model_validator(mode="after")
    def _leaves_something(self) -> Self:
        left = 1 - float(self.shares(32, 32).mean())
        if left < _LEAST_LEFT:
            raise ValueError(f"the mask leaves {left:.0%} of the picture; it must leave at least {_LEAST_LEFT:.0%}")
        return self

    @property
    def digest(self) -> str:
        """The SHA-256 of its content, hexadecimal: frames encoded under the same digest were masked alike."""
        return hashlib.sha256(json.dumps(self.polygons, separators=(",", ":")).encode()).hexdigest()

    def shares(self, height: int, width: int) -> NDArray[np.float32]:
        """The covered share of each cell of a grid over the frame; float32 [height, width], read-only."""
        return _shares(self, height, width)

    def covered(self, height: int, width: int) -> NDArray[np.bool_]:
        """Which cells of a grid over the frame are covered by half or more; bool [height, width]."""
        return np.asarray(self.shares(height, width) >= 0.5)


class RangedMask(Mask):
    """What of a camera's frames counts where they have 16 bits of which it uses a range: the areas, and the values.

    ``polygons`` may be empty.
    """

    polygons: tuple[Polygon, ...] = ()
    value_range: ValueRange

    @property
    def digest(self) -> str:
        """The SHA-256 of its content, hexadecimal."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    def areas(self) -> Mask | None:
        """The mask of the areas alone; None if there are none."""
        return Mask(polygons=self.polygons) if self.polygons else None


def with_range(mask: Mask | None, value_range: ValueRange | None) -> Mask | None:
    """A mask of areas and of values, of which either may be missing."""
    if value_range is None:
        return mask
    return RangedMask(polygons=() if mask is None else mask.polygons, value_range=value_range)


def range_in(mask: Mask | None) -> ValueRange | None:
    """The values that count of frames of 16 bits; None: all, by their upper 8 bits."""
    return mask.value_range if isinstance(mask, RangedMask) else None


@lru_cache(maxsize=64)
def _shares(mask: Mask, height: int, width: int) -> NDArray[np.float32]:
    """Draw the mask finer than the grid and average it; results are cached, as a camera has few grids."""
    canvas = np.zeros((height * _FINER, width * _FINER), np.uint8)
    size = np.array([width, height], np.float64) * _FINER
    for polygon in mask.polygons:
        # Corners lie between pixels, while OpenCV counts from pixel centres; 4 fractional bits are precise enough.
        corners = np.rint((np.array(polygon) * size - 0.5) * 16).astype(np.int32)
        one = np.zeros_like(canvas)  # one by one: in a single call, the overlap of two polygons would stay uncovered
        cv2.fillPoly(one, [corners], 1, shift=4)
        canvas |= one
    shares = canvas.reshape(height, _FINER, width, _FINER).mean(axis=(1, 3), dtype=np.float32)
    shares.setflags(write=False)
    return shares
