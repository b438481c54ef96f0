"""The visual words relative to which regional features are described (thesis, equations 3.6 and 4.6)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import faiss
import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel

ITERATIONS = 30
"""Iterations of k-means."""

POINTS_PER_WORD = 4096
"""k-means draws at most this many features for each word."""

FEATURES_PER_FRAME = 150
"""At most this many features of a frame are pooled."""


@dataclass(frozen=True)
class Vocabulary:
    """V words, and which features they were learned from.

    centers: float32 [V, K].
    origin: identity of the feature extractor (weights, layers, N, steps, …); an encoder refuses the vocabulary for any
        other.

    Raises:
        InvalidModel: the centers are not a finite matrix.
    """

    centers: NDArray[np.float32]
    origin: str

    def __post_init__(self) -> None:
        if self.centers.ndim != 2 or not np.isfinite(self.centers).all():
            raise InvalidModel("the vocabulary is not a finite V x K matrix.")


def train_vocabulary(features: NDArray[np.float32], words: int, seed: int, origin: str) -> Vocabulary:
    """Cluster pooled regional features with k-means (equations 3.6 and 4.6), starting from k-means++.

    The same seed gives the same words.

    Args:
        features: float32 [T, K], of many frames.
        words: V.
        seed: of the initial centres.
        origin: identity of the extractor that made the features.

    Raises:
        InvalidModel: there are fewer features than words, or they are not finite.
    """
    if len(features) < words:
        raise InvalidModel(f"{len(features)} regional features cannot make {words} words; give more images.")
    if not np.isfinite(features).all():
        raise InvalidModel("the regional features are not finite.")
    kmeans = faiss.Kmeans(
        features.shape[1],
        words,
        niter=ITERATIONS,
        seed=seed,
        init_method=faiss.ClusteringInitMethod_KMEANS_PLUS_PLUS,
        min_points_per_centroid=1,
        max_points_per_centroid=POINTS_PER_WORD,
    )
    kmeans.train(np.ascontiguousarray(features, np.float32))
    return Vocabulary(np.array(kmeans.centroids, np.float32), origin)


def pool_features(
    frames: Iterable[NDArray[np.float32]], seed: int, per_frame: int = FEATURES_PER_FRAME
) -> NDArray[np.float32]:
    """Draw some of the features of each frame, so that memory stays bounded.

    Args:
        frames: for each frame its regional features, float32 [T_i, K]; T_i may be 0.
        seed: of the draw.
        per_frame: the largest number of features taken from a frame.

    Returns:
        float32 [T, K].

    Raises:
        InvalidModel: no frame has a feature.
    """
    generator = np.random.default_rng(seed)
    retained = []
    for features in frames:
        if len(features) > per_frame:
            features = features[generator.choice(len(features), per_frame, replace=False)]
        retained.append(features)
    if not any(len(features) for features in retained):
        raise InvalidModel("no frame has a region of interest; give other images or a smaller step.")
    return np.concatenate([features for features in retained if len(features)])
