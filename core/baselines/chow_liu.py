"""The tree that best approximates how binary variables depend on each other.

Chow, Liu: Approximating Discrete Probability Distributions with Dependence Trees, IEEE Transactions on
Information Theory 14(3), 1968.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Probabilities = NDArray[np.float64]
Observations = NDArray[np.bool_]


@dataclass(frozen=True)
class Tree:
    """A directed tree over V binary variables z.

    parents: int64 [V]; the root is its own.
    marginals: float64 [V], p(z_q = 1).
    given: float64 [2, V], p(z_q = 1 | z_parent = 0) and p(z_q = 1 | z_parent = 1); the root's are its marginal.
    """

    parents: NDArray[np.int64]
    marginals: Probabilities
    given: Probabilities


def probability(counts: Probabilities, total: int, cells: int) -> Probabilities:
    """Shares of ``total`` observations, as if each of a pair's four cases had been seen half a time more, so that
    none is 0; ``cells`` of these cases are in ``counts`` (one for a pair, two for a variable alone)."""
    return (counts + 0.5 * cells) / (total + 2.0)


def mutual_information(observations: Observations) -> Probabilities:
    """Σ_ab p(a, b) log p(a, b) / p(a) p(b) of each pair of variables: bool [M, V] to float64 [V, V]."""
    total = len(observations)
    information = np.zeros((observations.shape[1],) * 2)
    values = [~observations, observations]
    for first in values:
        for second in values:
            both = probability((first.astype(np.float32).T @ second.astype(np.float32)).astype(np.float64), total, 1)
            rows, columns = (probability(value.sum(axis=0), total, 2) for value in (first, second))
            information += both * np.log(both / (rows[:, None] * columns))
    return information


def spanning_tree(information: Probabilities) -> NDArray[np.int64]:
    """Each variable's parent in the tree of the greatest sum of information, rooted at variable 0; int64 [V]."""
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    # SciPy takes a weight of 0 for no edge, so all are made positive.
    weights = information.max() + 1.0 - information
    np.fill_diagonal(weights, 0.0)
    _, parents = breadth_first_order(minimum_spanning_tree(weights), 0, directed=False)
    return np.where(parents < 0, np.arange(len(parents)), parents).astype(np.int64)


def chow_liu(observations: Observations) -> Tree:
    """The tree of M observations of V >= 1 variables, bool [M, V]."""
    total = len(observations)
    parents = spanning_tree(mutual_information(observations))
    marginals = probability(observations.sum(axis=0), total, 2)
    above = observations[:, parents]
    given = np.stack(
        [
            probability((observations & with_parent).sum(axis=0), total, 1)
            / probability(with_parent.sum(axis=0), total, 2)
            for with_parent in (~above, above)
        ]
    )
    return Tree(parents, marginals, np.where(parents == np.arange(len(parents)), marginals, given))
