"""The compiled loops of VLAD; ``core.method.equations.vlad`` says what they compute."""

from __future__ import annotations

import numba
import numpy as np

from core.kernels.regions import BLOCK, lowest_bit, reaching


@numba.njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "reassoc"})
def _highest(values):  # type: ignore[no-untyped-def]
    """The position of the highest of n > 0 finite values, the first of equal ones; float32 [n]."""
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
def _residuals(features, centers, closeness):  # type: ignore[no-untyped-def]
    """Σ (f - o_u) over the features assigned to each centre; float32 [V, K]."""
    vectors = np.zeros_like(centers)
    for t in range(len(features)):
        u = _highest(closeness[t])
        vector, feature, center = vectors[u], features[t], centers[u]
        for k in range(features.shape[1]):
            vector[k] += feature[k] - center[k]
    return vectors


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _normalize(vectors, gamma, intra):  # type: ignore[no-untyped-def]
    """Power and normalization in place; float32 [V, K]."""
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
def aggregated(features, centers, closeness, gamma, intra):  # type: ignore[no-untyped-def]
    """The VLAD of one frame, float32 [V, K].

    Args:
        features: float32 [T, K].
        centers: float32 [V, K].
        closeness: float32 [T, V]; the highest value of a row is the nearest centre's.
        gamma: float32.
        intra: whether each word's part is divided by its own norm, or all values by the norm of the whole.
    """
    vectors = _residuals(features, centers, closeness)
    _normalize(vectors, gamma, intra)
    return vectors
