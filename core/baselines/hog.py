"""Histograms of oriented gradients of the whole frame.

Dalal, Triggs: Histograms of Oriented Gradients for Human Detection, CVPR 2005.  The constants are those of
VPR-Bench (Zaffar et al., IJCV 2021), which made the published figures: the frame in colour, each pixel's
gradient that of its strongest channel, and blocks of one cell.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import cv2
import numpy as np

from core.baselines.entry import Constants, Entry, Ingredients, system_identity
from core.baselines.maps import unit
from core.baselines.system import About, Description, Index, InnerProducts, stack
from core.frames.preprocessing import Pixels

WINDOW, BLOCK, STRIDE, CELL, BINS = 512, 16, 8, 16, 9
CONSTANTS: Constants = {"window": WINDOW, "block": BLOCK, "stride": STRIDE, "cell": CELL, "bins": BINS}
ABOUT = About("hog", "HOG", "Dalal, Triggs: Histograms of Oriented Gradients for Human Detection, CVPR 2005", CONSTANTS)


class Hog:
    """One histogram vector of unit length; scores are cosines."""

    about, sequential = ABOUT, False

    def __init__(self) -> None:
        self.identity = system_identity(ABOUT)
        self._hog = cv2.HOGDescriptor((WINDOW, WINDOW), (BLOCK, BLOCK), (STRIDE, STRIDE), (CELL, CELL), BINS)

    def describe(self, pixels: Pixels) -> Description:
        began = time.perf_counter()
        histograms = self._hog.compute(cv2.resize(pixels, (WINDOW, WINDOW), interpolation=cv2.INTER_LINEAR))
        vector = unit(np.asarray(histograms, np.float32).reshape(-1))
        return Description({"descriptor": vector}, {"forward": 1e3 * (time.perf_counter() - began)})

    def index(self, references: Sequence[Description]) -> Index:
        return InnerProducts(stack(references))


def build(ingredients: Ingredients) -> Hog:
    ingredients.none(ABOUT)
    return Hog()


SYSTEMS: tuple[Entry, ...] = (Entry(ABOUT, build),)
