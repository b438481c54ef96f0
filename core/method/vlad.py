"""VLAD: the residuals of a frame's regional features from the words of a vocabulary, as one vector, and its score.

Thesis, equations 3.7–3.13 and 4.7–4.13 (``equations.py``); Jégou et al., 2010 (the vector), Arandjelović and
Zisserman, 2013 (intra-normalization).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.kernels.vlad import aggregated
from core.method.equations import Normalization

Array = NDArray[np.float32]


def aggregate(features: Array, centers: Array, gamma: float, normalization: Normalization) -> Array:
    """The VLAD of one frame, flattened.

    Args:
        features: float32 [T, K]; T = 0 gives zeros.
        centers: float32 [V, K].
        gamma: γ, the exponent of the power normalization.

    Returns:
        float32 [V·K].
    """
    centers = np.ascontiguousarray(centers, np.float32)
    # f·o - ‖o‖²/2: the highest value of a row is the nearest word's.
    closeness = features @ centers.T - np.float32(0.5) * np.einsum("vk,vk->v", centers, centers)
    vectors = aggregated(features, centers, closeness, np.float32(gamma), normalization == "intra")
    return np.asarray(vectors, np.float32).reshape(-1)


def scores(inner_products: Array, words: int, normalization: Normalization) -> Array:
    """Scores from inner products of flattened VLADs, float32 of any shape.

    With ``intra`` the cosines of equation 3.12 are inner products, so that the inner product of two flattened VLADs is
    J itself (equation 3.13), and the score is J / V, in [-1, 1].  With ``global`` the score is the inner product.

    Args:
        words: V.
    """
    return inner_products / np.float32(words) if normalization == "intra" else inner_products
