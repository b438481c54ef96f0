"""How much a robot's view has changed, and whether there is a view at all, from a very small grey picture.

A small picture averages away the noise of a camera and of compression, which descriptors of regions do not, and is the
same whatever the encoder.  Two of them are compared after each is freed of its mean and its contrast, so that exposure
does not matter: with a and b of mean 0 and length 1, the change is the distance |a - b| = √(2 - 2 a·b), from 0 to 2.
It grows in proportion to a small motion of the picture, so that the changes of a slow motion add up as the motion does.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.masks import Mask
from core.frames.preprocessing import Pixels

WIDTH, HEIGHT = 32, 24
"""Size of the small picture."""

UNIFORM = 6.0
"""A view with a lower standard deviation, in grey levels of 256, is uniform: a covered lens, however noisy.  At 640x480
pixels, covers with noise of up to 30 grey levels have 1 or less; the photographs of train/day_night taken by night have
9.6 or more."""

STILL = 0.1
"""A view that has changed by less shows the same.  Noise, compression and another exposure change photographs of
camvid, tower, corridor and lip6 by at most 0.07.  On corridor, where frames are most alike, 0.36 is the median change
from one frame to the next, and 0.13 the least."""

NEW = 0.3
"""A view that has changed by this much counts as a whole look.  On the runs that ``filter.LEAVING`` names, 0.1 to 0.45
give the same likelihood within 2 %; so does no tempering at all but that of views that have not changed."""


@dataclass(frozen=True, eq=False)
class View:
    """One frame, very small: uint8 [HEIGHT * WIDTH], grey levels, row by row; masked parts have one and the same."""

    levels: NDArray[np.uint8]

    @property
    def uniform(self) -> bool:
        """Whether the frame shows hardly anything."""
        return float(self.levels.std()) < UNIFORM

    def change(self, other: View) -> float:
        """By how much two views differ, from 0 to 2; uniform views differ from all others by √2."""
        return float(np.sqrt(max(0.0, 2 - 2 * float(self._normal() @ other._normal()))))

    def _normal(self) -> NDArray[np.float64]:
        centred = self.levels - self.levels.mean(dtype=np.float64)
        length = float(np.linalg.norm(centred))
        return centred / length if length else centred


def view_of(pixels: Pixels, mask: Mask | None = None) -> View:
    """The view that a frame shows.

    Args:
        pixels: uint8 [H, W, 3], BGR, of any size.
        mask: the pixels to ignore in it.
    """
    small = cv2.resize(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    levels = np.asarray(small, np.uint8)
    if mask is not None:
        hidden = mask.covered(HEIGHT, WIDTH)
        levels[hidden] = round(float(levels[~hidden].mean())) if not hidden.all() else 0
    return View(levels.ravel())


def novelty(change: float) -> float:
    """The weight of a frame whose view has changed by ``change`` since the last one that counted, from 0 to 1."""
    return 0.0 if change < STILL else min(1.0, change / NEW)
