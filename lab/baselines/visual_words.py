"""Large vocabularies of visual words, learned in a run from the training frames (FAB-MAP, Cross-Region-BoW).

``core.method.vocabulary`` trains the few words of an encoder with great care; for thousands of words from a few ten
thousand features that would take many minutes and gain nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel
from lab.baselines.system import Array

ITERATIONS = 10
POINTS_PER_WORD = 32
"""The largest number of features per word that are clustered; of more, a random choice is taken."""

BLOCK = 4096
"""Features assigned at a time, so that memory stays bounded."""


def train_words(frames: Sequence[NDArray[np.generic]], count: int, seed: int) -> Array:
    """``count`` words by k-means over the features of all frames; if there are fewer features, each is a word.

    Args:
        frames: of each frame its features, real numbers [T_i, K].
        seed: of the initial words and of the choice of features.

    Returns:
        float32 [V, K].

    Raises:
        InvalidModel: no frame has a feature.
    """
    import faiss

    found = [frame for frame in frames if len(frame)]
    if not found:
        raise InvalidModel("no training image has a feature to make words of; give other images.")
    features = np.concatenate(found).astype(np.float32, copy=False)
    if len(features) <= count:
        return features
    kmeans = faiss.Kmeans(
        features.shape[1],
        count,
        niter=ITERATIONS,
        seed=seed,
        min_points_per_centroid=1,
        max_points_per_centroid=POINTS_PER_WORD,
    )
    kmeans.train(features)
    return np.array(kmeans.centroids, np.float32)


def nearest_words(features: Array, centers: Array) -> NDArray[np.int64]:
    """The nearest word of each feature in L2, ties to the lower index: float32 [T, K], [V, K] to int64 [T]."""
    halves = 0.5 * np.einsum("vk,vk->v", centers, centers)
    found = np.empty(len(features), np.int64)
    for start in range(0, len(features), BLOCK):
        block = features[start : start + BLOCK]
        found[start : start + BLOCK] = np.argmax(block @ centers.T - halves, axis=1)
    return found
