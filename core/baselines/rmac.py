"""R-MAC: the maxima of each map in square regions of several scales.

Tolias, Sicre, Jégou: Particular Object Retrieval with Integral Max-Pooling of CNN Activations, ICLR
2016.  The regional vectors are power- and L2-normalized as in the thesis (section 4.4.1), where the paper
whitens them by a PCA of another image set.  As one vector they are summed; compared by mutual regions they
are kept apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from core.baselines.entry import Constants, Entry, Ingredients
from core.baselines.maps import Array, MapsSystem, pooled, unit
from core.baselines.mutual import MutualRegions
from core.baselines.system import About, Description, Index
from core.method.equations import power

if TYPE_CHECKING:
    pass

L = 3
OVERLAP = 0.4
GAMMA = 0.5
LAYER = "conv4"
PAPER = "Tolias, Sicre, Jégou: Particular Object Retrieval with Integral Max-Pooling of CNN Activations, ICLR 2016"
CONSTANTS: Constants = {"L": L, "overlap": OVERLAP, "gamma": GAMMA, "layer": LAYER}


def extra_regions(height: int, width: int) -> int:
    """How many regions more the longer side has at each scale, from 1 to 6, so that neighbours at scale 1
    overlap by about 40 %; none on a square."""
    short, excess = min(height, width), abs(height - width)
    if excess == 0:
        return 0
    return min(range(1, 7), key=lambda more: abs((short - excess / more) / short - OVERLAP))


def regions(height: int, width: int) -> list[tuple[slice, slice]]:
    """The square regions of scales l = 1 … L with sides 2·min(height, width)/(l + 1), as rows and columns."""
    more = extra_regions(height, width)
    found = []
    for scale in range(1, L + 1):
        side = max(1, 2 * min(height, width) // (scale + 1))
        tops = starts(height, side, scale + (more if height > width else 0))
        lefts = starts(width, side, scale + (more if width > height else 0))
        found += [(slice(top, top + side), slice(left, left + side)) for top in tops for left in lefts]
    return found


def starts(length: int, side: int, count: int) -> list[int]:
    """Where ``count`` windows of ``side`` cells begin, evenly from the first cell to the last possible one."""
    step = (length - side) / (count - 1) if count > 1 else 0.0
    return [math.floor(index * step) for index in range(count)]


def regional_vectors(maps: Array) -> Array:
    """Maxima in each region, power- and L2-normalized: float32 [X, Y, K] to [T, K]."""
    maxima = np.stack([maps[rows, columns].max(axis=(0, 1)) for rows, columns in regions(*maps.shape[:2])])
    return unit(power(maxima, GAMMA))


def rmac(maps: Array) -> Array:
    """Σ of the regional vectors: float32 [X, Y, K] to [K]."""
    return regional_vectors(maps).sum(axis=0)


class MutualRmac(MapsSystem):
    """The regions of R-MAC compared one with another: the sum of the cosines of mutual ones."""

    def keep(self, maps: list[Array]) -> dict[str, Array]:
        vectors = regional_vectors(*maps)
        return {"regions": vectors, "weights": np.ones(len(vectors), np.float32)}

    def index(self, references: Sequence[Description]) -> Index:
        return MutualRegions(references, scale=1 / len(references[0].arrays["weights"]))


def build_mutual(ingredients: Ingredients) -> MutualRmac:
    return MutualRmac(MUTUAL, ingredients.extractor(LAYER))


MUTUAL = About("rmac-mutual", "RMAC, mutual regions", PAPER, CONSTANTS)
SYSTEMS: tuple[Entry, ...] = (
    pooled(About("rmac", "RMAC", PAPER, CONSTANTS), rmac, LAYER),
    Entry(MUTUAL, build_mutual),
)
