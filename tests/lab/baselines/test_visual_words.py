"""Vocabularies learned in a run."""

from __future__ import annotations

import numpy as np
import pytest

from core.errors import InvalidModel
from lab.baselines.visual_words import BLOCK, nearest_words, train_words


def test_clusters_are_found_and_the_same_for_the_same_seed() -> None:
    generator = np.random.default_rng(0)
    centers = np.array([[0, 0], [10, 0], [0, 10]], np.float32)
    frames = [centers + generator.normal(0, 0.1, (3, 2)).astype(np.float32) for _ in range(50)]
    words = train_words(frames, 3, seed=1)
    np.testing.assert_allclose(sorted(words.round().tolist()), sorted(centers.tolist()))
    np.testing.assert_allclose(words, train_words(frames, 3, seed=1), rtol=1e-5, atol=1e-5)


def test_fewer_features_than_words_are_all_words() -> None:
    features = np.arange(6, dtype=np.float32).reshape(3, 2)
    np.testing.assert_array_equal(train_words([features[:1], features[1:]], 10, seed=0), features)


def test_no_features_is_said() -> None:
    with pytest.raises(InvalidModel, match="no training image"):
        train_words([np.empty((0, 4), np.float32)], 10, seed=0)


def test_nearest_words_across_blocks_and_of_none() -> None:
    centers = np.array([[0, 0], [4, 0], [4, 0]], np.float32)
    features = np.zeros((BLOCK + 2, 2), np.float32)
    features[-1] = [2.5, 9]
    found = nearest_words(features, centers)
    assert found[-1] == 1 and not found[:-1].any()  # the first of two equal words
    assert nearest_words(features[:0], centers).shape == (0,)
