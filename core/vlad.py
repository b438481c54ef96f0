"""VLAD: the residuals of a frame's regional features from the words of a vocabulary.

Thesis, equations 3.7–3.11 and 4.7–4.11; Jégou et al., 2010 (the vector), Arandjelović and
Zisserman, 2013 (intra-normalization).
"""

from __future__ import annotations

from typing import Literal

import numba
import numpy as np
from numpy.typing import NDArray

Normalization = Literal["intra", "global"]
Array = NDArray[np.float32]


def assign(features: Array, centers: Array) -> NDArray[np.int64]:
    """Z = α(F): the nearest centre in L2 of each feature (eqs. 3.7, 4.7), ties to the lower index.

    Args:
        features: float32 [T, K].
        centers: float32 [V, K].

    Returns:
        int64 [T].
    """
    # ‖f - o‖² = ‖f‖² - 2 f·o + ‖o‖², and ‖f‖² is the same for all centres.
    closeness = features @ centers.T
    closeness -= 0.5 * np.einsum("vk,vk->v", centers, centers)
    return np.argmax(closeness, axis=1)


def residuals(features: Array, centers: Array) -> Array:
    """v_u = Σ (f - o_u) over the features assigned to u (eqs. 3.8, 4.8); float32 [V, K]."""
    return _summed(features, centers, assign(features, centers))


@numba.njit(cache=True, nogil=True)
def _summed(features, centers, words):  # type: ignore[no-untyped-def]
    vectors = np.zeros_like(centers)
    for t in range(len(features)):
        u = words[t]
        for k in range(features.shape[1]):
            vectors[u, k] += features[t, k] - centers[u, k]
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


def aggregate(features: Array, centers: Array, gamma: float, normalization: Normalization) -> Array:
    """The VLAD of one frame, flattened.

    Args:
        features: float32 [T, K]; T = 0 gives zeros.
        centers: float32 [V, K].

    Returns:
        float32 [V·K].
    """
    vectors = residuals(features, centers)
    return normalize(power(vectors, gamma), normalization).reshape(-1)
