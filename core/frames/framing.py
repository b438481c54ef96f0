"""How much of a place's view a frame shows, and the frame as it would be in the whole of that view.

A camera of a longer lens, and a picture that was cut, show the middle of a place's view enlarged.  Networks compare
pictures as they are, so such a frame resembles a place some steps ahead, where a camera of the usual lens sees about
the same.  Shrunk into the middle of a picture whose border is masked, it is as large as in the right place's picture.
A frame that shows more than the place is cut instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.masks import Mask, RangedMask
from core.frames.preprocessing import Pixels

AREA = 320 * 240
"""Pixels of a framed picture at most: as many as the networks see."""

LEAST_SHOWN = 0.12
"""The share of a place's view that a frame has to show; a mask may leave a tenth of a picture."""

SAME = 0.05
"""Framings whose logarithms differ by less are one: a camera that grows by so much is one step of a walk nearer."""


@dataclass(frozen=True)
class Framing:
    """The part of a place's view that a frame shows, about its middle.

    across, down: shares of the width and of the height; over 1 where the frame shows more than the place.
    """

    across: float
    down: float

    @property
    def shown(self) -> float:
        """The share of the place's view that the frame shows, in (0, 1]."""
        return min(1.0, self.across) * min(1.0, self.down)

    def zoomed(self, factor: float) -> Framing:
        """The framing if the lens is so much longer, with ``factor`` under 1, or shorter."""
        return Framing(self.across * factor, self.down * factor)

    def is_like(self, other: Framing) -> bool:
        """Whether both are one but for what a step of a walk changes."""
        return bool(max(abs(np.log(self.across / other.across)), abs(np.log(self.down / other.down))) < SAME)

    def applied(self, pixels: Pixels, width: int, height: int, mask: Mask | None) -> tuple[Pixels, Mask | None] | None:
        """A frame as it is in the place's view, and the mask of what it does not show.

        Args:
            pixels: uint8 [H, W, 3], BGR, of the frame at any size.
            width, height: of the frame itself, in pixels, which give its shape.
            mask: what of the frame is hidden.

        Returns:
            None if the frame shows too little of the view, or has a mask and shows more than the view.
        """
        areas = mask.areas() if isinstance(mask, RangedMask) else mask
        if self.shown < LEAST_SHOWN or (areas is not None and max(self.across, self.down) > 1):
            return None
        rows, columns = pixels.shape[:2]
        top, left = (
            round(side * max(0.0, 1 - 1 / share) / 2) for side, share in ((rows, self.down), (columns, self.across))
        )
        part = pixels[top : rows - top, left : columns - left]
        shown = min(1.0, 1 / self.across) * width, min(1.0, 1 / self.down) * height
        across, down = min(1.0, self.across), min(1.0, self.down)
        whole = shown[0] / across, shown[1] / down
        scale = min(1.0, sqrt(AREA / (whole[0] * whole[1])))
        inner = max(1, round(shown[0] * scale)), max(1, round(shown[1] * scale))
        before = round((whole[0] * scale - inner[0]) / 2), round((whole[1] * scale - inner[1]) / 2)
        small = cv2.resize(part, inner, interpolation=cv2.INTER_AREA)
        framed = cv2.copyMakeBorder(small, before[1], before[1], before[0], before[0], cv2.BORDER_REFLECT)
        hidden = [] if areas is None else [[self._placed(corner) for corner in polygon] for polygon in areas.polygons]
        left_edge, right_edge = (1 - across) / 2, (1 + across) / 2
        upper, lower = (1 - down) / 2, (1 + down) / 2
        if across < 1:
            hidden += [[(0.0, 0.0), (left_edge, 0.0), (left_edge, 1.0), (0.0, 1.0)]]
            hidden += [[(right_edge, 0.0), (1.0, 0.0), (1.0, 1.0), (right_edge, 1.0)]]
        if down < 1:
            hidden += [[(0.0, 0.0), (1.0, 0.0), (1.0, upper), (0.0, upper)]]
            hidden += [[(0.0, lower), (1.0, lower), (1.0, 1.0), (0.0, 1.0)]]
        polygons = tuple(tuple(polygon) for polygon in hidden)
        try:
            return np.asarray(framed, np.uint8), Mask(polygons=polygons) if polygons else None
        except ValueError:  # with the camera's own mask too little is left
            return None

    def _placed(self, corner: tuple[float, float]) -> tuple[float, float]:
        """A corner of the frame's mask in the view."""
        return 0.5 + (corner[0] - 0.5) * self.across, 0.5 + (corner[1] - 0.5) * self.down

    def in_frame(self, shares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions in the frame, of positions in the view; float64 [n, 2], both in shares of width and height."""
        return np.asarray(0.5 + (shares - 0.5) / np.array([self.across, self.down]), np.float64)


SAME_VIEW = Framing(1.0, 1.0)
"""The frame shows what the place shows."""
