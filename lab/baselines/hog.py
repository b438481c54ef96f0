"""Histograms of oriented gradients of the whole frame.

Dalal, Triggs: Histograms of Oriented Gradients for Human Detection, CVPR 2005.  The constants are those of
VPR-Bench (Zaffar et al., IJCV 2021), which made the published figures: the frame in colour, each pixel's
gradient that of its strongest channel, and blocks of one cell.
"""

from __future__ import annotations

import cv2
import numpy as np

from core.frames.preprocessing import Pixels
from lab.baselines.system import About, Array, Constants, Resources, VectorSystem, unit

WINDOW, BLOCK, STRIDE, CELL, BINS = 512, 16, 8, 16, 9
CONSTANTS: Constants = {"window": WINDOW, "block": BLOCK, "stride": STRIDE, "cell": CELL, "bins": BINS}
ABOUT = About("hog", "HOG", "Dalal, Triggs: Histograms of Oriented Gradients for Human Detection, CVPR 2005", CONSTANTS)


class Hog(VectorSystem):
    """One histogram vector of unit length; scores are cosines."""

    def __init__(self, about: About) -> None:
        super().__init__(about)
        self._hog = cv2.HOGDescriptor((WINDOW, WINDOW), (BLOCK, BLOCK), (STRIDE, STRIDE), (CELL, CELL), BINS)

    def vector(self, pixels: Pixels) -> Array:
        histograms = self._hog.compute(cv2.resize(pixels, (WINDOW, WINDOW), interpolation=cv2.INTER_LINEAR))
        return unit(np.asarray(histograms, np.float32).reshape(-1))


def build(about: About, resources: Resources) -> Hog:
    resources.refuse_weights(about)
    return Hog(about)
