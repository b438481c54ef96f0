"""A linear projection of features under which the same spot looks alike in any light, and different spots do not.

This is Fisher's discriminant (Fisher, 1936; as learned whitening of local descriptors: Mikolajczyk and Matas, 2007).
The differences between a cell's feature and that of the same cell under other conditions show which directions do not
matter.  Features are whitened by the covariance of these differences, and the directions of largest variance stay.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from core.kernels.projections import finish_rows
from core.method.equations import unit_length

Array = NDArray[np.float32]

SHRINKAGE = 0.5
"""This share of the mean variance is added to that of every direction, so that whitening does not amplify noise."""


@dataclass(frozen=True)
class Projection:
    """A projection of features from K values to fewer.

    mean: m, float32 [K], the mean of unit-length features.
    matrix: W, float32 [K, d], columns by falling importance, so that the first columns are a projection, too.
    """

    mean: Array
    matrix: Array

    def __call__(self, features: Array, values: int) -> Array:
        """Project features f to unit-length p ∝ (f/|f| - m) W; a zero row stays zero.

        The encoder computes the same from products that it already has (:meth:`finish`).

        Args:
            features: float32 [n, K].
            values: how many columns of W to use.

        Returns:
            float32 [n, values].
        """
        projected = unit_length((unit_length(features) - self.mean) @ self.matrix[:, :values])
        projected[~features.any(axis=1)] = 0
        return projected

    def products(self, features: Array) -> Array:
        """f W of features f, float32 [n, K] to [n, d]; the product of a sum of features is the sum of products."""
        return np.asarray(features @ self.matrix, np.float32)

    @cached_property
    def shift(self) -> Array:
        """m W, float32 [d]."""
        return np.asarray(self.mean @ self.matrix, np.float32)

    def finish(self, products: Array, features: Array, values: int) -> Array:
        """Project features whose products are known: (f/|f| - m) W = f W / |f| - m W, then to unit length.

        Args:
            products: f W, float32 [n, d].
            features: f, float32 [n, K].
            values: how many columns of W to use.

        Returns:
            float32 [n, values].
        """
        projected = np.empty((len(features), values), np.float32)
        finish_rows(np.ascontiguousarray(products), np.ascontiguousarray(features), self.shift, projected)
        return projected


def fit_projection(clear: Array, changed: Array, values: int) -> Projection:
    """Fit the projection under which pairs differ least, relative to the variance of all features.

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
    return Projection(mean.astype(np.float32), discriminant(within, total, values, SHRINKAGE))


def discriminant(within: NDArray[np.float64], between: NDArray[np.float64], values: int, shrinkage: float) -> Array:
    """The directions of most scatter ``between``, where ``within`` is what it is to be large against.

    Args:
        within, between: float64 [K, K], symmetric.
        values: d, how many directions.
        shrinkage: this share of the mean variance within is added to that of every direction.

    Returns:
        float32 [K, d], columns by falling importance, each with a shrunk variance within of one.
    """
    shrunk = within.copy()
    shrunk[np.diag_indices_from(shrunk)] += shrinkage * np.trace(within) / len(within) + 1e-12
    variances, directions = np.linalg.eigh(shrunk)
    whitening = directions / np.sqrt(variances)
    importance, rotation = np.linalg.eigh(whitening.T @ between @ whitening)
    retained = np.argsort(-importance)[:values]
    return np.ascontiguousarray(whitening @ rotation[:, retained], np.float32)
