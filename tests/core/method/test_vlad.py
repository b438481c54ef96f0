"""VLADs and scores on features for which the answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from core.maps.forms import pack_descriptors, unpack_descriptors
from core.maps.records import Precision
from core.method.equations import Normalization, matching_score, vlad
from core.method.vlad import aggregate, are_normalized, scores
from service.maps.imports import LENGTH_TOLERANCES


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


@pytest.mark.parametrize("normalization", ["intra", "global"])
@pytest.mark.parametrize("gamma", [0.5, 0.2, 1.0])
@pytest.mark.parametrize("shape", [(90, 10, 24), (300, 128, 16), (40, 65, 7), (1, 1, 3), (0, 3, 4)])
def test_equals_the_equations(shape: tuple[int, int, int], gamma: float, normalization: Normalization) -> None:
    count, words, values = shape
    generator = np.random.default_rng(words)
    features = generator.random((count, values)).astype(np.float32)
    centers = generator.random((words, values)).astype(np.float32)
    made = aggregate(features, centers, gamma, normalization)
    wanted = vlad(features.astype(np.float64), centers.astype(np.float64), gamma, normalization)
    assert made.dtype == np.float32
    # A residual near 0 is a difference of nearly equal numbers, and a power under 1 magnifies its rounding.
    np.testing.assert_allclose(made, wanted.reshape(-1), atol=2e-3 if gamma < 0.5 else 2e-4)


@pytest.mark.parametrize("normalization", ["intra", "global"])
@pytest.mark.parametrize("precision", ["half", "compressed"])
@pytest.mark.parametrize(("words", "values"), [(16, 24), (128, 64), (1, 300)])
def test_stored_vlads_have_their_length_and_others_have_not(
    normalization: Normalization, precision: Precision, words: int, values: int
) -> None:
    generator = np.random.default_rng(5)
    centers = generator.standard_normal((words, values)).astype(np.float32)
    features = (generator.standard_normal((40, values)).astype(np.float32) for _ in range(20))
    made = np.stack([aggregate(one, centers, 0.5, normalization) for one in features])
    stored = unpack_descriptors(pack_descriptors(made, precision), precision, made.shape[1])
    tolerance = LENGTH_TOLERANCES[precision]
    assert are_normalized(stored, words, normalization, tolerance).all()
    for factor in (0.0, 0.5, 2.0, 1000.0):
        assert not are_normalized(factor * stored, words, normalization, tolerance).any()
