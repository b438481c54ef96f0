"""VLAD: the residuals of a frame's regional features from the words of a vocabulary.

Thesis, equations 3.7–3.11 and 4.7–4.11; Jégou et al., 2010 (the vector), Arandjelović and
Zisserman, 2013 (intra-normalization).
"""

from __future__ import annotations

from typing import Literal

import numba
import numpy as np
from numpy.typing import NDArray

from core.kernels.bit_masks import BLOCK, lowest_bit, reaching
from core.kernels.products import ConstantMatrix

Normalization = Literal["intra", "global"]
Array = NDArray[np.float32]


class Words:
    """The words of a vocabulary, made ready once to be held against the features of many frames.

    Args:
        centers: float32 [V, K].
    """

    def __init__(self, centers: Array) -> None:
        self.centers = np.ascontiguousarray(centers, np.float32)
        # ‖f - o‖² = ‖f‖² - 2 f·o + ‖o‖², and ‖f‖² is the same for all centres.
        self.closeness = ConstantMatrix(self.centers.T, np.float32(-0.5) * np.einsum("vk,vk->v", centers, centers))
        """float32 [T, K] to [T, V]: the highest value of a row is the nearest word's."""


def ready(centers: Array | Words) -> Words:
    """The words of these centres, float32 [V, K], if they are not ready yet."""
    return centers if isinstance(centers, Words) else Words(centers)


def assign(features: Array, centers: Array | Words) -> NDArray[np.int64]:
    """Z = α(F): the nearest centre in L2 of each feature (eqs. 3.7, 4.7), ties to the lower index.

    Args:
        features: float32 [T, K].
        centers: float32 [V, K].

    Returns:
        int64 [T].
    """
    return np.argmax(ready(centers).closeness(features), axis=1)


def residuals(features: Array, centers: Array | Words) -> Array:
    """v_u = Σ (f - o_u) over the features assigned to u (eqs. 3.8, 4.8); float32 [V, K]."""
    words = ready(centers)
    made: Array = _summed(features, words.centers, words.closeness(features))
    return made


@numba.njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "reassoc"})
def _highest(values):  # type: ignore[no-untyped-def]
    """The place of the highest of finite values, the first of equal ones; float32 [n]."""
    most = values[0]
    for i in range(len(values)):
        most = max(most, values[i])
    whole = len(values) - len(values) % BLOCK
    for start in range(0, whole, BLOCK):
        bits = reaching(values, start, most)
        if bits != 0:
            return start + int(lowest_bit(bits))
    for i in range(whole, len(values)):
        if values[i] >= most:
            return i
    return 0


@numba.njit(cache=True, nogil=True)
def _summed(features, centers, closeness):  # type: ignore[no-untyped-def]
    vectors = np.zeros_like(centers)
    for t in range(len(features)):
        u = _highest(closeness[t])
        vector, feature, center = vectors[u], features[t], centers[u]
        for k in range(features.shape[1]):
            vector[k] += feature[k] - center[k]
    return vectors


def power(vectors: Array, gamma: float) -> Array:
    """v := sign(v)·|v|^γ element by element (eqs. 3.9, 4.9)."""
    magnitudes = np.abs(vectors)
    magnitudes = np.sqrt(magnitudes) if gamma == 0.5 else np.power(magnitudes, np.float32(gamma))
    return np.copysign(magnitudes, vectors)


def normalize(vectors: Array, normalization: Normalization) -> Array:
    """Divide by L2 norms; zero stays zero.

    ``intra``: each v_u by its own norm (eqs. 3.10–3.11).  ``global``: the whole by its norm.
    """
    if normalization == "intra":
        norms = np.sqrt(np.einsum("vk,vk->v", vectors, vectors))[:, None]
    else:
        norms = np.full((len(vectors), 1), np.linalg.norm(vectors), np.float32)
    return np.divide(vectors, norms, out=np.zeros_like(vectors), where=norms > 0)


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _finish(vectors, gamma, intra):  # type: ignore[no-untyped-def]
    """:func:`power` and :func:`normalize` at once and in place; float32 [V, K]."""
    whole = np.float32(0)
    for u in range(vectors.shape[0]):
        square = np.float32(0)
        for k in range(vectors.shape[1]):
            value = vectors[u, k]
            magnitude = np.sqrt(abs(value)) if gamma == 0.5 else abs(value) ** gamma
            vectors[u, k] = np.copysign(magnitude, value)
            square += magnitude * magnitude
        whole += square
        if intra and square > 0:
            inverse = np.float32(1) / np.sqrt(square)
            for k in range(vectors.shape[1]):
                vectors[u, k] *= inverse
    if not intra and whole > 0:
        inverse = np.float32(1) / np.sqrt(whole)
        for u in range(vectors.shape[0]):
            for k in range(vectors.shape[1]):
                vectors[u, k] *= inverse


@numba.njit(cache=True, nogil=True)
def _aggregated(features, centers, closeness, gamma, intra):  # type: ignore[no-untyped-def]
    """Both steps; float32 [V, K]."""
    vectors = _summed(features, centers, closeness)
    _finish(vectors, gamma, intra)
    return vectors


def aggregate(features: Array, centers: Array | Words, gamma: float, normalization: Normalization) -> Array:
    """The VLAD of one frame, flattened.

    Args:
        features: float32 [T, K]; T = 0 gives zeros.
        centers: float32 [V, K].

    Returns:
        float32 [V·K].
    """
    words = ready(centers)
    vectors = _aggregated(
        features, words.centers, words.closeness(features), np.float32(gamma), normalization == "intra"
    )
    return np.asarray(vectors, np.float32).reshape(-1)
