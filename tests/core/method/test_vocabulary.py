"""k-means words: the same by seed, bounded in memory, honest about too little input."""

from __future__ import annotations

import numpy as np
import pytest

from core.errors import InvalidModel
from core.method.vocabulary import Vocabulary, pool_features, train_vocabulary


def blobs(per_blob: int = 50) -> np.ndarray:
    generator = np.random.default_rng(0)
    centers = np.eye(6, 24, dtype=np.float32) * 10
    noise = generator.standard_normal((6, per_blob, 24)).astype(np.float32) * 0.1
    return (centers[:, None] + noise).reshape(-1, 24)


def test_finds_separated_words() -> None:
    made = train_vocabulary(blobs(), 6, seed=1, origin="here").centers
    strongest = sorted(made.argmax(axis=1).tolist())
    assert strongest == [0, 1, 2, 3, 4, 5]


def test_is_the_same_by_seed_and_another_by_another() -> None:
    features = np.random.default_rng(2).random((3000, 24)).astype(np.float32)
    first, again, other = (train_vocabulary(features, 16, seed, "here").centers for seed in (5, 5, 6))
    np.testing.assert_allclose(first, again, rtol=1e-5)
    assert not np.allclose(first, other)


def test_too_few_features_are_refused() -> None:
    with pytest.raises(InvalidModel, match="more images"):
        train_vocabulary(np.ones((3, 4), np.float32), 4, 0, "here")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(value: float) -> None:
    with pytest.raises(InvalidModel, match="finite"):
        train_vocabulary(np.full((10, 4), value, np.float32), 2, 0, "here")
    with pytest.raises(InvalidModel, match="finite"):
        Vocabulary(np.full((2, 4), value, np.float32), "here")


def test_pooling_takes_a_bounded_share_of_each_frame() -> None:
    frames = [np.full((n, 3), n, np.float32) for n in (5, 0, 40)]
    pooled = pool_features(iter(frames), seed=0, per_frame=10)
    assert len(pooled) == 15
    np.testing.assert_array_equal(pooled, pool_features(iter(frames), seed=0, per_frame=10))


def test_pooling_nothing_is_refused() -> None:
    with pytest.raises(InvalidModel, match="no frame"):
        pool_features([np.zeros((0, 3), np.float32)], seed=0)
