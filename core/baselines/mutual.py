"""Frames compared region by region: only pairs that choose each other count.

Chen, Maffra, Sa, Chli: Only Look Once, Mining Distinctive Landmarks from ConvNet for Visual Place
Recognition, IROS 2017; the thesis compares the regions of R-MAC so too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.baselines.system import Description, stack

Array = NDArray[np.float32]

BLOCK = 64
"""References compared at a time, so that memory stays bounded."""


def mutual_scores(query: Array, query_weights: Array, references: Array, reference_weights: Array) -> Array:
    """Σ over mutual nearest neighbours of cosine x weight x weight.

    A region of the query and one of a reference are mutual if each is the other's most alike; of
    equally alike ones the first.

    Args:
        query: float32 [T, K], regions of unit length; rows of zeros are no regions.
        query_weights: float32 [T].
        references: float32 [R, U, K], likewise.
        reference_weights: float32 [R, U].

    Returns:
        float32 [R].
    """
    count, regions, width = references.shape
    cosines = (references.reshape(-1, width) @ query.T).reshape(count, regions, len(query))  # R x U x T
    chosen = cosines.argmax(axis=2)  # R x U: by each reference region
    choosing = cosines.argmax(axis=1)  # R x T: by each query region
    mutual = np.take_along_axis(choosing, chosen, axis=1) == np.arange(regions)
    best = np.take_along_axis(cosines, chosen[..., None], axis=2)[..., 0]
    weighted = best * reference_weights * query_weights[chosen]
    return np.where(mutual, weighted, np.float32(0)).sum(axis=1, dtype=np.float32)


class MutualRegions:
    """An index of descriptions with ``regions`` [T, K] and ``weights`` [T], T the same for all.

    scale: what the sums are multiplied with.
    """

    def __init__(self, references: Sequence[Description], scale: float) -> None:
        self._regions, self._weights = stack(references, "regions"), stack(references, "weights")
        self._scale = np.float32(scale)

    def compare(self, queries: Sequence[Description]) -> Array:
        scores = np.empty((len(queries), len(self._regions)), np.float32)
        for row, query in zip(scores, queries, strict=True):
            regions, weights = stack([query], "regions")[0], stack([query], "weights")[0]
            for start in range(0, len(row), BLOCK):
                block = slice(start, start + BLOCK)
                row[block] = self._scale * mutual_scores(regions, weights, self._regions[block], self._weights[block])
        return scores
