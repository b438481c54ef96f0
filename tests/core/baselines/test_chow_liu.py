"""The Chow-Liu tree of data that was drawn from a known one."""

from __future__ import annotations

import numpy as np
import pytest

from core.baselines.chow_liu import chow_liu, mutual_information

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
