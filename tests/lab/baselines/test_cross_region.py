"""Cross-Region: landmarks and their features by hand, the rarity of words, and the systems on real activations."""

from __future__ import annotations

import numpy as np
import pytest

from core.errors import InvalidModel
from core.frames.preprocessing import Pixels
from core.method.catalogue import EncoderCatalogue
from lab.baselines.cross_region import (
    BLOCK,
    CrossRegion,
    CrossRegionBow,
    CrossRegionVlad,
    MutualRegions,
    cross_features,
    find_landmarks,
    mutual_scores,
    rarity,
)
from lab.baselines.registry import build
from lab.baselines.system import Description


def late_maps() -> np.ndarray:
    """Two maps of 4 x 5: a diagonal group of three cells and a single cell; one group along a row."""
    late = np.zeros((4, 5, 2), np.float32)
    late[0, 0, 0], late[1, 1, 0], late[2, 1, 0] = 1, 4, 1  # mean 2, connected over a corner
    late[3, 4, 0] = 3
    late[1, 1:4, 1] = [2, 2, 5]  # mean 3
    return late


def test_landmarks_by_falling_mean_and_first_occurrence() -> None:
    boxes, channels = find_landmarks(late_maps(), 10)
    assert boxes == [
        (slice(3, 4), slice(4, 5)),
        (slice(1, 2), slice(1, 4)),
        (slice(0, 3), slice(0, 2)),
    ]
    assert channels.tolist() == [0, 1, 0]
    assert find_landmarks(late_maps(), 1)[0] == boxes[:1]


def test_groups_of_two_maps_never_join() -> None:
    late = np.zeros((2, 2, 3), np.float32)
    late[0, 0] = 1
    assert len(find_landmarks(late, 10)[0]) == 3


def test_features_are_early_descriptors_weighted_by_the_late_map() -> None:
    early = np.zeros((4, 5, 2), np.float32)
    early[3, 4] = [5, 0]
    early[1, 1], early[1, 3] = [1, 1], [0, 2]
    features = cross_features(early, late_maps())
    second = np.array([2, 2 + 5 * 2]) / np.hypot(2, 12)  # 2 x (1, 1) + 2 x (0, 0) + 5 x (0, 2)
    third = np.array([1, 1]) / np.sqrt(2)  # its box holds (1, 1) alone
    np.testing.assert_allclose(features, [[1, 0], second, third], rtol=1e-6)


def test_a_blank_frame_has_no_landmark() -> None:
    blank = np.zeros((4, 5, 2), np.float32)
    assert cross_features(blank, blank).shape == (0, 2)


def test_layers_of_two_grids_are_refused() -> None:
    with pytest.raises(InvalidModel, match="one grid"):
        cross_features(np.zeros((3, 3, 2), np.float32), np.zeros((4, 3, 2), np.float32))


def test_rarity_is_the_inverse_document_frequency() -> None:
    frames = [np.array([0, 0, 1]), np.array([1]), np.array([1, 2]), np.array([1])]
    np.testing.assert_allclose(rarity(frames, 4), np.log10([4, 1, 4, 4]), rtol=1e-6)


def scene(seed: int) -> Pixels:
    generator = np.random.default_rng(seed)
    coarse = generator.integers(0, 255, (12, 16, 3))
    return np.kron(coarse, np.ones((10, 10, 1), np.int64)).astype(np.uint8)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["cross-region-vlad", "cross-region-bow-2.6k"])
def test_places_are_distinguished_after_training(name: str) -> None:
    system = build(name, models=EncoderCatalogue())
    assert isinstance(system, CrossRegion) and isinstance(system, CrossRegionBow | CrossRegionVlad)
    with pytest.raises(InvalidModel, match="train it"):
        system.describe(scene(0))
    with pytest.raises(InvalidModel):
        system.train([], seed=0)
    untrained = system.identity
    system.words = 16 if isinstance(system, CrossRegionVlad) else 300
    system.train((scene(seed) for seed in range(50, 58)), seed=0)
    assert system.identity != untrained

    places = [system.describe(scene(seed)) for seed in range(4)]
    shifted = [system.describe(np.roll(scene(seed), 4, axis=1)) for seed in range(4)]
    scores = system.index(places).score(shifted)
    assert scores.argmax(axis=1).tolist() == [0, 1, 2, 3]
    assert np.isfinite(scores).all() and scores.dtype == np.float32
    blank = system.describe(np.zeros((120, 160, 3), np.uint8))
    assert not system.index(places).score([blank]).any()


def test_the_bag_of_words_score_by_hand() -> None:
    def frame(regions: list[list[float]], weights: list[float]) -> Description:
        return Description({"regions": np.array(regions, np.float32), "weights": np.array(weights, np.float32)})

    system = build("cross-region-bow", models=EncoderCatalogue())
    query = frame([[1, 0], [0.6, 0.8]], [0.5, 2])
    reference = frame([[0.8, 0.6], [0, 0]], [3, 0])
    # Cosines 0.8 and 0.96: the reference's landmark and the query's second one choose each other; over N = 200.
    expected = 0.96 * 2 * 3 / 200
    assert system.index([reference]).score([query])[0, 0] == pytest.approx(expected, rel=1e-6)


# Mutual regions


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
    scores = MutualRegions(frames, scale=1 / 3).score(frames)
    assert scores.shape == (BLOCK + 3, BLOCK + 3)
    np.testing.assert_allclose(np.diag(scores), 1, rtol=1e-5)
    np.testing.assert_allclose(scores, scores.T, atol=1e-6)
    assert (scores.argmax(axis=1) == np.arange(BLOCK + 3)).all()
