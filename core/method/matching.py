"""The score of two VLADs (thesis, equations 3.12–3.14 and 4.12–4.14)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.method.vlad import Normalization

Array = NDArray[np.float32]


def cluster_cosines(a: Array, b: Array, words: int) -> Array:
    """j_u, the cosine of the u-th parts of two VLADs (eqs. 3.12, 4.12); 0 where either is zero.

    Args:
        a, b: float32 [V·K].
        words: V.

    Returns:
        float32 [V].
    """
    left, right = a.reshape(words, -1), b.reshape(words, -1)
    norms = np.linalg.norm(left, axis=1) * np.linalg.norm(right, axis=1)
    products = np.einsum("vk,vk->v", left, right)
    return np.divide(products, norms, out=np.zeros_like(products), where=norms > 0)


def summed_cosine(a: Array, b: Array, words: int) -> float:
    """J = Σ_u j_u (eqs. 3.13, 4.13), in [-V, V]."""
    return float(cluster_cosines(a, b, words).sum(dtype=np.float64))


def scores(inner_products: Array, words: int, normalization: Normalization) -> Array:
    """What users see of inner products of flattened descriptors.

    Intra-normalized VLADs: the inner product is J itself, and the score J / V in [-1, 1].
    Unit vectors: the inner product is the score.
    """
    return inner_products / np.float32(words) if normalization == "intra" else inner_products
