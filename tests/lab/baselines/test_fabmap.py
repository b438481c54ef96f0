"""FAB-MAP's likelihood against sums over all that could be, on a vocabulary of four words."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from core.errors import InvalidModel
from core.frames.preprocessing import Pixels
from lab.baselines.fabmap import (
    P_Z_GIVEN_E,
    P_Z_GIVEN_NOT_E,
    FabMap,
    Tree,
    chow_liu,
    local_features,
    log_likelihoods,
    log_odds,
    mutual_information,
)
from lab.baselines.system import Trainable

TREE = Tree(
    parents=np.array([0, 0, 1, 1]),
    marginals=np.array([0.4, 0.3, 0.5, 0.2]),
    given=np.array([[0.4, 0.2, 0.35, 0.1], [0.4, 0.45, 0.85, 0.43]]),
)
PLACES = np.array([[1, 0, 0, 1], [1, 1, 1, 0], [0, 0, 0, 0]], np.bool_)
FRAMES = [np.array(values, np.bool_) for values in itertools.product((False, True), repeat=4)]


def detector(z: bool, e: bool) -> float:
    seen = P_Z_GIVEN_E if e else P_Z_GIVEN_NOT_E
    return seen if z else 1 - seen


def marginal(q: int, z: bool) -> float:
    return TREE.marginals[q] if z else 1 - TREE.marginals[q]


def conditional(q: int, z: bool, above: bool) -> float:
    one = TREE.given[int(above), q]
    return one if z else 1 - one


def observation(q: int, z: bool, e: bool, above: bool) -> float:
    """p(z_q | e_q, z_parent) in the form the paper gives it, 1 / (1 + α / β)."""
    alpha = marginal(q, z) * detector(not z, e) * conditional(q, not z, above)
    beta = marginal(q, not z) * detector(z, e) * conditional(q, z, above)
    return beta / (alpha + beta)


def likelihood(frame: np.ndarray, there: list[float]) -> float:
    """p(Z | L) by a sum over every combination of what may exist at the place."""
    total = 0.0
    for exists in itertools.product((False, True), repeat=4):
        product = 1.0
        for q, e in enumerate(exists):
            product *= there[q] if e else 1 - there[q]
            product *= observation(q, bool(frame[q]), e, bool(frame[TREE.parents[q]]))
        total += product
    return total


def belief(place: np.ndarray) -> list[float]:
    """p(e_q = 1 | L) by Bayes, its prior the word's marginal."""
    found = []
    for q, z in enumerate(place):
        there, absent = detector(z, True) * marginal(q, True), detector(z, False) * marginal(q, False)
        found.append(there / (there + absent))
    return found


@pytest.mark.parametrize("frame", FRAMES)
def test_likelihoods_are_those_of_the_sum_over_everything(frame: np.ndarray) -> None:
    expected = [likelihood(frame, belief(place)) for place in PLACES] + [likelihood(frame, list(TREE.marginals))]
    np.testing.assert_allclose(np.exp(log_likelihoods(frame, PLACES, TREE)), expected, rtol=1e-9)


def test_likelihoods_of_all_frames_add_up_to_one() -> None:
    total = sum(np.exp(log_likelihoods(frame, PLACES, TREE)) for frame in FRAMES)
    np.testing.assert_allclose(total, 1, rtol=1e-9)


def test_log_odds_are_those_of_the_posterior() -> None:
    likelihoods = np.array([-3.0, -1.0, -2.5, -1.5])
    posterior = np.exp(likelihoods) / np.exp(likelihoods).sum()
    np.testing.assert_allclose(log_odds(likelihoods), np.log(posterior / (1 - posterior))[:-1], rtol=1e-12)


def test_log_odds_tell_certain_matches_apart() -> None:
    sure, surer = log_odds(np.array([0.0, -800.0, -900.0])), log_odds(np.array([0.0, -1200.0, -1300.0]))
    np.testing.assert_allclose(sure, [800, -800])
    np.testing.assert_allclose(surer, [1200, -1200])


def scene(seed: int) -> Pixels:
    """A frame full of corners: random rectangles."""
    generator = np.random.default_rng(seed)
    canvas = np.full((120, 160, 3), 128, np.uint8)
    for _ in range(60):
        x, y, width, height = generator.integers((0, 0, 5, 5), (150, 110, 40, 40)).tolist()
        cv2.rectangle(canvas, (x, y), (x + width, y + height), generator.integers(0, 255, 3).tolist(), -1)
    return canvas


@pytest.mark.thorough
def test_places_are_recognized_after_training() -> None:
    system = FabMap()
    assert isinstance(system, Trainable)
    untrained = system.identity
    places = [scene(seed) for seed in range(12)]
    system.train((scene(seed) for seed in range(100, 130)), seed=0)
    assert system.identity != untrained

    index = system.index([system.describe(place) for place in places])
    moved = [np.ascontiguousarray(np.roll(place, 3, axis=1)) for place in places]
    scores = index.score([system.describe(place) for place in moved])
    assert scores.shape == (12, 12) and scores.dtype == np.float32 and np.isfinite(scores).all()
    assert (scores.argmax(axis=1) == np.arange(12)).mean() > 0.9


def test_a_blank_frame_and_a_single_place_have_scores() -> None:
    system = FabMap()
    system.train([scene(1), scene(2)], seed=0)
    blank = system.describe(np.zeros((120, 160, 3), np.uint8))
    assert np.isfinite(system.index([system.describe(scene(1))]).score([blank])).all()


@pytest.mark.parametrize(
    ("given", "seen", "method"),
    [((1280, 960), (640, 480), cv2.INTER_AREA), ((160, 120), (320, 240), cv2.INTER_CUBIC), ((400, 300),) * 2 + (None,)],
)
def test_large_frames_are_shrunk_and_small_ones_enlarged(
    given: tuple[int, int], seen: tuple[int, int], method: int | None
) -> None:
    grey = cv2.resize(scene(1)[:, :, 0], given, interpolation=cv2.INTER_CUBIC)
    resized = grey if method is None else cv2.resize(grey, seen, interpolation=method)
    found, expected = (local_features(np.asarray(np.dstack([image] * 3), np.uint8)) for image in (grey, resized))
    assert len(expected) > 10
    np.testing.assert_array_equal(found, expected)


def test_a_frame_of_corridors_size_has_features_enough() -> None:
    grey = cv2.cvtColor(scene(1), cv2.COLOR_BGR2GRAY)
    assert len(local_features(scene(1))) > 2 * len(cv2.SIFT.create().detectAndCompute(grey, None)[0])


def test_a_system_without_training_or_features_says_so() -> None:
    with pytest.raises(InvalidModel, match="no training image"):
        FabMap().train([np.zeros((64, 64, 3), np.uint8)], seed=0)
    with pytest.raises(InvalidModel, match="train it"):
        FabMap().describe(scene(1))


# The tree of Chow and Liu: data that was drawn from a known one


PARENTS = [0, 0, 0, 1, 1, 2]  # of each variable; 0 is the root
P_IF_PARENT_IS = np.array([[0.4, 0.1, 0.7, 0.2, 0.3, 0.15], [0.4, 0.8, 0.2, 0.9, 0.05, 0.75]])


def draw(count: int) -> np.ndarray:
    generator = np.random.default_rng(3)
    observations = np.zeros((count, len(PARENTS)), np.bool_)
    for variable, parent in enumerate(PARENTS):
        chances = P_IF_PARENT_IS[observations[:, parent].astype(int), variable]
        observations[:, variable] = generator.random(count) < chances
    return observations


def test_a_known_tree_is_found_with_its_probabilities() -> None:
    observations = draw(20_000)
    tree = chow_liu(observations)
    np.testing.assert_array_equal(tree.parents, PARENTS)
    np.testing.assert_allclose(tree.given, P_IF_PARENT_IS, atol=0.02)
    np.testing.assert_allclose(tree.marginals, observations.mean(axis=0), atol=1e-3)


def test_variables_may_come_in_any_order() -> None:
    order = np.array([4, 2, 0, 5, 3, 1])
    tree = chow_liu(draw(20_000)[:, order])
    edges = {frozenset((order[child], order[parent])) for child, parent in enumerate(tree.parents) if child != parent}
    assert edges == {frozenset((child, parent)) for child, parent in enumerate(PARENTS) if child != parent}
    assert tree.parents[0] == 0


def test_mutual_information_by_hand() -> None:
    observations = np.array([[0, 0, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1]], np.bool_)
    information = mutual_information(observations)
    # Pairs (0, 1): two of the cases were seen twice; each counts half a time more, of 4 + 2.
    same, other = 2.5 / 6, 0.5 / 6
    expected = 2 * same * np.log(same / 0.25) + 2 * other * np.log(other / 0.25)
    assert information[0, 1] == pytest.approx(expected)
    assert information[0, 2] == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(information, information.T, atol=1e-12)


def test_one_variable_and_one_observation() -> None:
    tree = chow_liu(np.array([[True]]))
    np.testing.assert_array_equal(tree.parents, [0])
    np.testing.assert_allclose(tree.marginals, [2 / 3])
    np.testing.assert_allclose(tree.given, [[2 / 3], [2 / 3]])
