"""Regions that choose each other, by hand."""

from __future__ import annotations

import numpy as np

from core.baselines.mutual import BLOCK, MutualRegions, mutual_scores
from core.baselines.system import Description

ONES = np.ones(3, np.float32)


def test_only_regions_that_choose_each_other_count() -> None:
    query = np.array([[1, 0, 0], [0.8, 0.6, 0], [0, 0, 1]], np.float32)
    reference = np.array([[0.96, 0.28, 0], [0, 1, 0], [0, 0, 0]], np.float32)
    # Cosines, reference by query: (0.96, 0.936, 0), (0, 0.6, 0), (0, 0, 0).
    # Reference 0 and query 0 choose each other.  Reference 1 chooses query 1, which prefers reference 0 by 0.936.
    scores = mutual_scores(query, ONES, reference[None], ONES[None])
    np.testing.assert_allclose(scores, [0.96], rtol=1e-6)


def test_weights_of_both_regions_multiply() -> None:
    axes = np.eye(3, dtype=np.float32)
    permuted = axes[[2, 0, 1]]
    weights, others = np.array([1, 2, 3], np.float32), np.array([10, 100, 1000], np.float32)
    scores = mutual_scores(axes, weights, np.stack([permuted, axes]), np.stack([others, others]))
    np.testing.assert_allclose(scores, [3 * 10 + 1 * 100 + 2 * 1000, 10 + 200 + 3000])


def test_the_index_gives_the_same_score_in_every_block() -> None:
    generator = np.random.default_rng(5)

    def frame(vectors: np.ndarray) -> Description:
        return Description({"regions": vectors.astype(np.float32), "weights": ONES})

    vectors = generator.normal(size=(BLOCK + 3, 3, 4))
    vectors /= np.linalg.norm(vectors, axis=2, keepdims=True)
    frames = [frame(regions) for regions in vectors]
    scores = MutualRegions(frames, scale=1 / 3).compare(frames)
    assert scores.shape == (BLOCK + 3, BLOCK + 3)
    np.testing.assert_allclose(np.diag(scores), 1, rtol=1e-5)
    np.testing.assert_allclose(scores, scores.T, atol=1e-6)
    assert (scores.argmax(axis=1) == np.arange(BLOCK + 3)).all()
