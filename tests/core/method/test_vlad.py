"""VLAD and the score, against loops written straight from the equations."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from core.method.matching import cluster_cosines, scores, summed_cosine
from core.method.vlad import Normalization, aggregate, assign

Array = NDArray[np.float32]


def obvious_vlad(features: Array, centers: Array, gamma: float, normalization: Normalization) -> Array:
    """Equations 4.7–4.11 in float64, one loop an index."""
    vectors = np.zeros(centers.shape)
    for feature in features.astype(np.float64):
        u = int(np.argmin([np.sum((feature - center) ** 2) for center in centers]))
        vectors[u] += feature - centers[u]
    vectors = np.sign(vectors) * np.abs(vectors) ** gamma
    for u in range(len(vectors)):
        norm = np.linalg.norm(vectors[u] if normalization == "intra" else vectors)
        if normalization == "intra" and norm > 0:
            vectors[u] /= norm
    if normalization == "global":
        vectors /= np.linalg.norm(vectors)
    return vectors.reshape(-1).astype(np.float32)


@pytest.mark.parametrize("normalization", ["intra", "global"])
@pytest.mark.parametrize("gamma", [0.5, 0.2, 1.0])
def test_follows_the_equations(normalization: Normalization, gamma: float) -> None:
    generator = np.random.default_rng(3)
    features = generator.random((90, 24)).astype(np.float32)
    centers = generator.random((10, 24)).astype(np.float32)
    made = aggregate(features, centers, gamma, normalization)
    np.testing.assert_allclose(made, obvious_vlad(features, centers, gamma, normalization), atol=2e-4)
    assert made.dtype == np.float32


def test_a_tie_goes_to_the_lower_word() -> None:
    centers = np.array([[0, 2], [2, 0]], np.float32)
    assert assign(np.array([[1, 1]], np.float32), centers).tolist() == [0]


def test_empty_and_zero_clusters_stay_zero() -> None:
    centers = np.array([[0, 0], [5, 5], [100, 100]], np.float32)
    features = np.array([[1, 0], [5, 5]], np.float32)  # word 1: a zero residual; word 2: nothing
    assert aggregate(features, centers, 0.5, "intra").tolist() == [1, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("normalization", ["intra", "global"])
def test_no_region_gives_zeros_and_no_nan(normalization: Normalization) -> None:
    made = aggregate(np.zeros((0, 4), np.float32), np.ones((3, 4), np.float32), 0.5, normalization)
    assert made.tolist() == [0.0] * 12


def test_the_inner_product_of_intra_vlads_is_the_summed_cosine() -> None:
    generator = np.random.default_rng(4)
    centers = generator.random((16, 24)).astype(np.float32)
    a, b = (aggregate(generator.random((40, 24)).astype(np.float32), centers, 0.5, "intra") for _ in range(2))
    cosines = cluster_cosines(a, b, 16)
    assert summed_cosine(a, b, 16) == pytest.approx(float(a @ b), abs=1e-5)
    assert float(scores(np.array(a @ b), 16, "intra")) == pytest.approx(float(cosines.mean()), abs=1e-6)


def test_a_frame_scores_its_share_of_filled_clusters_against_itself() -> None:
    centers = np.eye(4, dtype=np.float32) * 10
    frame = aggregate(np.array([[9, 1, 0, 0], [1, 9, 0, 0]], np.float32), centers, 0.5, "intra")
    assert summed_cosine(frame, frame, 4) / 4 == pytest.approx(0.5)


def test_global_scores_are_the_inner_products() -> None:
    assert scores(np.array([0.25], np.float32), 128, "global").tolist() == [0.25]
