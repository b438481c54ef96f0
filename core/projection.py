"""A linear view of a feature in which the same spot looks alike under any light, and different spots do not.

Fisher's discriminant (Fisher, 1936; as learned whitening of local descriptors: Mikolajczyk and Matas, 2007).
The differences between a cell's feature and that of the same cell under other conditions span what does not
matter; features are whitened by their covariance, and of what is then left the directions of most spread are kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

SHRINKAGE = 0.5
"""Share of the mean variance added to every direction's, so that quiet directions are not blown up into noise."""


@dataclass(frozen=True)
class Projection:
    """From a feature of K values to one of fewer.

    mean: float32 [K], of unit-length features.
    matrix: float32 [K, d], columns by falling importance, so that the first ones are a projection too.
    """

    mean: Array
    matrix: Array

    def __call__(self, features: Array, values: int) -> Array:
        """Unit-length projections of n features, float32 [n, K] to [n, values]; zero stays zero."""
        return self.finish(self.products(features), np.sqrt(np.einsum("nk,nk->n", features, features)), values)

    def products(self, features: Array) -> Array:
        """f W, float32 [n, K] to [n, d]: linear, so that a sum of features has the sum of their products."""
        return np.asarray(features @ self.matrix, np.float32)

    @cached_property
    def _shift(self) -> Array:
        """m W, float32 [d]."""
        return np.asarray(self.mean @ self.matrix, np.float32)

    def finish(self, products: Array, lengths: Array, values: int) -> Array:
        """Unit-length projections from the products and lengths of n features; float32 [n, values].

        (f/|f| - m) W = f W / |f| - m W.
        """
        projected = products[:, :values] * _inverse(lengths)[:, None]
        projected -= self._shift[:values]
        projected *= (_inverse(np.sqrt(np.einsum("nd,nd->n", projected, projected))) * (lengths > 0))[:, None]
        return projected


def _inverse(lengths: Array) -> Array:
    """1 / x, and 0 for 0; float32 [n]."""
    return np.divide(np.float32(1), lengths, out=np.zeros_like(lengths), where=lengths > 0)


def fit_projection(clear: Array, changed: Array, values: int) -> Projection:
    """The projection under which pairs agree best in relation to all features' spread.

    Args:
        clear, changed: float32 [n, K], unit-length features of the same n cells under two conditions.
        values: d, how many directions to keep, at most K.

    Raises:
        ValueError: the arrays differ in shape, hold fewer than two pairs, or K < d.
    """
    if clear.shape != changed.shape or len(clear) < 2 or not 1 <= values <= clear.shape[1]:
        raise ValueError(f"{values} directions from pairs of shape {clear.shape} and {changed.shape}")
    a, b = clear.astype(np.float64), changed.astype(np.float64)
    mean = (a.mean(axis=0) + b.mean(axis=0)) / 2
    difference, centred = a - b, np.concatenate([a, b]) - mean
    within = difference.T @ difference / (2 * len(a))  # S_w
    total = centred.T @ centred / len(centred)  # S_t
    within[np.diag_indices_from(within)] += SHRINKAGE * np.trace(within) / len(within) + 1e-12
    variances, directions = np.linalg.eigh(within)
    whitening = directions / np.sqrt(variances)
    importance, rotation = np.linalg.eigh(whitening.T @ total @ whitening)
    kept = np.argsort(-importance)[:values]
    return Projection(mean.astype(np.float32), np.ascontiguousarray(whitening @ rotation[:, kept], np.float32))
