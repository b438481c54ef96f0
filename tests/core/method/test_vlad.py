"""VLADs and scores on features for which the answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from core.method.equations import Normalization, matching_score
from core.method.vlad import aggregate, scores


def test_empty_and_zero_clusters_stay_zero() -> None:
    centers = np.array([[0, 0], [5, 5], [100, 100]], np.float32)
    features = np.array([[1, 0], [5, 5]], np.float32)  # word 1: a zero residual; word 2: no feature
    assert aggregate(features, centers, 0.5, "intra").tolist() == [1, 0, 0, 0, 0, 0]


@pytest.mark.parametrize("normalization", ["intra", "global"])
def test_no_region_gives_zeros_and_no_nan(normalization: Normalization) -> None:
    made = aggregate(np.zeros((0, 4), np.float32), np.ones((3, 4), np.float32), 0.5, normalization)
    assert made.tolist() == [0.0] * 12


def test_the_inner_product_of_intra_vlads_is_the_summed_cosine() -> None:
    generator = np.random.default_rng(4)
    centers = generator.random((16, 24)).astype(np.float32)
    a, b = (aggregate(generator.random((40, 24)).astype(np.float32), centers, 0.5, "intra") for _ in range(2))
    score = matching_score(a.reshape(16, 24), b.reshape(16, 24))
    assert float(a @ b) == pytest.approx(score, abs=1e-5)
    assert float(scores(np.array(a @ b), 16, "intra")) == pytest.approx(score / 16, abs=1e-6)


def test_global_scores_are_the_inner_products() -> None:
    assert scores(np.array([0.25], np.float32), 128, "global").tolist() == [0.25]
