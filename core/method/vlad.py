"""VLAD: the residuals of a frame's regional features from the words of a vocabulary, as one vector, and its score.

Thesis, equations 3.7–3.13 and 4.7–4.13 (``equations.py``); Jégou et al., 2010 (the vector), Arandjelović and
Zisserman, 2013 (intra-normalization).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.method.equations import Normalization, assign, normalize, power

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
    nearest = assign(features, centers)
    chosen = np.zeros((len(centers), len(features)), np.float32)
    chosen[nearest, np.arange(len(features))] = 1
    residuals = chosen @ features - chosen.sum(axis=1, keepdims=True) * centers  # Σ f - n o, equation 4.8
    return np.asarray(normalize(power(residuals, gamma), normalization), np.float32).reshape(-1)


def scores(inner_products: Array, words: int, normalization: Normalization) -> Array:
    """Scores from inner products of flattened VLADs, float32 of any shape.

    With ``intra`` the cosines of equation 3.12 are inner products, so that the inner product of two flattened VLADs is
    J itself (equation 3.13), and the score is J / V, in [-1, 1].  With ``global`` the score is the inner product.

    Args:
        words: V.
    """
    return inner_products / np.float32(words) if normalization == "intra" else inner_products


def are_normalized(descriptors: Array, words: int, normalization: Normalization, tolerance: float) -> NDArray[np.bool_]:
    """Which flattened VLADs have the length that :func:`aggregate` gives them; bool [n].

    Any other length would make a place more or less like every frame than its cosine says.

    Args:
        descriptors: float32 [n, D]; with ``intra``, D is a multiple of V.
        words: V.
        tolerance: by how much a length may differ from 1, since stored values are rounded.
    """
    parts = words if normalization == "intra" else 1
    vectors = descriptors.reshape(len(descriptors), parts, -1)
    lengths = np.sqrt(np.einsum("nvk,nvk->nv", vectors, vectors, dtype=np.float64))
    fits = np.abs(lengths - 1) <= tolerance
    if normalization == "intra":
        fits |= lengths == 0  # no feature of the frame belongs to the word
    return np.asarray(fits.all(axis=1) & (lengths > 0).any(axis=1))
