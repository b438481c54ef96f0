"""PCA whitening of descriptors (Jégou and Chum: Negative Evidences and Co-occurrences in Image Retrieval, 2012)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel
from core.method.equations import unit_length

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Whitening:
    """A projection of descriptors from D values to d of variance one.

    mean: float32 [D].
    matrix: float32 [D, d], columns by falling variance before.

    Raises:
        InvalidModel: the arrays do not fit each other, or are not finite.
    """

    mean: Array
    matrix: Array

    def __post_init__(self) -> None:
        fits = self.matrix.ndim == 2 and self.mean.shape == self.matrix.shape[:1]
        if not fits or not (np.isfinite(self.mean).all() and np.isfinite(self.matrix).all()):
            raise InvalidModel("the whitening is not a finite mean and matrix.")

    @property
    def values(self) -> int:
        """d."""
        return int(self.matrix.shape[1])

    def __call__(self, descriptors: Array) -> Array:
        """Whiten descriptors, float32 [n, D], to unit length, float32 [n, d]; a row of zeros stays zero."""
        whitened = unit_length((descriptors - self.mean) @ self.matrix)
        whitened[~descriptors.any(axis=1)] = 0
        return np.asarray(whitened, np.float32)

    def arrays(self) -> dict[str, Array]:
        """Its arrays by name."""
        return {"mean": self.mean, "matrix": self.matrix}


def fit_whitening(descriptors: Array, values: int) -> Whitening:
    """Fit a whitening to descriptors of different frames.

    Args:
        descriptors: float32 [n, D].
        values: d.

    Raises:
        InvalidModel: the frames differ in fewer than d directions; there are too few of them, or too similar ones.
    """
    mean = descriptors.mean(axis=0, dtype=np.float64)
    centred = descriptors - mean
    products = centred @ centred.T if len(centred) < centred.shape[1] else centred.T @ centred
    squares, vectors = np.linalg.eigh(products)
    retained = np.argsort(-squares)[:values]
    if len(retained) < values or squares[retained[-1]] <= 1e-9 * max(1e-12, squares[retained[0]]):
        raise InvalidModel(
            f"{len(descriptors)} frames do not differ in {values} directions; give more, or whiten to fewer."
        )
    directions = (
        centred.T @ vectors[:, retained] / np.sqrt(squares[retained])
        if len(products) == len(centred)
        else vectors[:, retained]
    )
    deviations = np.sqrt(squares[retained] / len(centred))
    return Whitening(mean.astype(np.float32), np.ascontiguousarray(directions / deviations, np.float32))
