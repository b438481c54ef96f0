"""FAB-MAP: the probability of a frame's visual words at each place, and at a new one.

Cummins, Newman: FAB-MAP: Probabilistic Localization and Mapping in the Space of Appearance, International
Journal of Robotics Research 27(6), 2008.  The local features are SIFT's: OpenCV's wheels do not contain the
paper's SURF.  A place is known by one frame, no motion is assumed, and the new place is the paper's mean
field approximation: sampling would draw from the training frames, which may show the very same places.

The words depend on each other by a tree: Chow, Liu: Approximating Discrete Probability Distributions with Dependence
Trees, IEEE Transactions on Information Theory 14(3), 1968.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel
from core.frames.preprocessing import Pixels
from lab.baselines.system import (
    About,
    Array,
    Constants,
    Description,
    ReferenceIndex,
    Resources,
    arrays_digest,
    system_identity,
)
from lab.baselines.visual_words import nearest_words, train_words

Observations = NDArray[np.bool_]
Reals = NDArray[np.float64]

V = 4000
LONGEST_SIDE, LEAST_LONGEST_SIDE = 640, 320
"""Pixels of a frame's longer side: a larger frame is shrunk, and a smaller one enlarged, which hardly has a feature."""
CONTRAST = 0.02
"""SIFT's threshold; OpenCV's 0.04 leaves less than a hundred features of a small frame.  Both were chosen in view of
corridor."""
P_Z_GIVEN_E, P_Z_GIVEN_NOT_E = 0.39, 0.0
"""The detector: the probability that a word is observed where its cause is present, and where it is absent."""

CONSTANTS: Constants = {
    "V": V,
    "features": "SIFT",
    "longest_side": (LEAST_LONGEST_SIDE, LONGEST_SIDE),
    "contrast": CONTRAST,
    "p(z|e)": P_Z_GIVEN_E,
    "p(z|not e)": P_Z_GIVEN_NOT_E,
    "new_place": "mean field",
}
ABOUT = About(
    "fabmap",
    "FAB-MAP",
    "Cummins, Newman: FAB-MAP: Probabilistic Localization and Mapping in the Space of Appearance, International "
    "Journal of Robotics Research 27(6), 2008",
    CONSTANTS,
)


# The tree of Chow and Liu


@dataclass(frozen=True)
class Tree:
    """A directed tree over V binary variables z.

    parents: int64 [V]; the root is its own.
    marginals: float64 [V], p(z_q = 1).
    given: float64 [2, V], p(z_q = 1 | z_parent = 0) and p(z_q = 1 | z_parent = 1); the root's are its marginal.
    """

    parents: NDArray[np.int64]
    marginals: Reals
    given: Reals


def probability(counts: Reals, total: int, cells: int) -> Reals:
    """Shares of ``total`` observations, none of them 0.

    Each of a pair's four cases counts as if it had been seen half a time more; ``cells`` of these cases are in
    ``counts`` (one for a pair, two for a variable alone).
    """
    return (counts + 0.5 * cells) / (total + 2.0)


def mutual_information(observations: Observations) -> Reals:
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


def spanning_tree(information: Reals) -> NDArray[np.int64]:
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


# Words and places


def local_features(pixels: Pixels) -> Array:
    """SIFT descriptors, float32 [T, 128] of whole numbers to 255; T may be 0.

    A large frame is shrunk first, a small one enlarged.
    """
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    side = max(grey.shape)
    scale = min(max(side, LEAST_LONGEST_SIDE), LONGEST_SIDE) / side
    if scale != 1:
        method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=method)
    _, descriptors = cv2.SIFT.create(contrastThreshold=CONTRAST).detectAndCompute(grey, None)
    return np.empty((0, 128), np.float32) if descriptors is None else np.asarray(descriptors, np.float32)


def existence(observed: Observations, marginals: Reals) -> Reals:
    """p(e_q = 1 | L): the probability that the cause of word q is at a place where q was, or was not, observed once.

    Its prior is the word's marginal, as in OpenFABMAP (Glover et al., ICRA 2012).

    Args:
        observed: bool [..., V].
        marginals: float64 [V], p(z_q = 1).
    """
    there = np.where(observed, P_Z_GIVEN_E, 1 - P_Z_GIVEN_E) * marginals
    absent = np.where(observed, P_Z_GIVEN_NOT_E, 1 - P_Z_GIVEN_NOT_E) * (1 - marginals)
    return np.asarray(there / (there + absent))


def observed_given(observed: Observations, tree: Tree) -> Reals:
    """p(z_q | e_q, z_parent) of a frame's observations z, for e_q = 0 and 1:
    proportional to p(z_q | e_q) p(z_q | z_parent) / p(z_q).

    Args:
        observed: bool [V].

    Returns:
        float64 [2, V].
    """
    detector = np.array([P_Z_GIVEN_NOT_E, P_Z_GIVEN_E])[:, None]  # p(z = 1 | e)
    given = np.where(observed[tree.parents], tree.given[1], tree.given[0])  # p(z = 1 | z_parent)
    seen = detector * given / tree.marginals
    unseen = (1 - detector) * (1 - given) / (1 - tree.marginals)
    return np.asarray(np.where(observed, seen, unseen) / (seen + unseen))


def log_likelihoods(observed: Observations, places: Observations, tree: Tree) -> Reals:
    """log p(Z | L) of a frame at each place, and last at the average place (mean field).

    Args:
        observed: bool [V], the frame's words.
        places: bool [R, V], each place's words.

    Returns:
        float64 [R + 1].
    """
    without, with_it = observed_given(observed, tree)
    # Each word has only two possible values: one for places where it was observed, one for the others.
    word = np.ones_like(observed)
    if_observed, if_not, average = (
        np.log(there * with_it + (1 - there) * without)
        for there in (existence(word, tree.marginals), existence(~word, tree.marginals), tree.marginals)
    )
    known = if_not.sum() + places.astype(np.float64) @ (if_observed - if_not)
    return np.append(known, average.sum())


def log_odds(likelihoods: Reals) -> Reals:
    """log p / (1 - p) of the posterior p(L | Z) of each place, all and the new one equally likely before.

    The logarithm of the odds, because the posterior itself is 1 to the last digit of many good matches.

    Args:
        likelihoods: float64 [R + 1], logarithms, the new place last.

    Returns:
        float64 [R].
    """
    best = int(np.argmax(likelihoods))
    scaled = np.exp(likelihoods - likelihoods[best])
    # The sum of all others.  For each place but the best one it contains the best one, so no digits are lost ...
    with np.errstate(divide="ignore"):
        others = likelihoods[best] + np.log(scaled.sum() - scaled)
    # ... and for the best one it is computed apart, because rounding would destroy it.
    others[best] = np.logaddexp.reduce(np.delete(likelihoods, best))
    return np.asarray((likelihoods - others)[:-1])


class Places:
    """Known places, each by the words of its frame."""

    def __init__(self, references: Sequence[Description], tree: Tree) -> None:
        self._tree = tree
        self._places = np.stack([unpack(reference, len(tree.parents)) for reference in references])

    def score(self, queries: Sequence[Description]) -> Array:
        frames = (unpack(query, len(self._tree.parents)) for query in queries)
        return np.stack([log_odds(log_likelihoods(frame, self._places, self._tree)) for frame in frames]).astype(
            np.float32
        )


def unpack(description: Description, words: int) -> Observations:
    """Which words a frame shows, bool [V]."""
    return np.unpackbits(description.arrays["words"].astype(np.uint8), count=words).astype(np.bool_)


class FabMap:
    """The words of a frame as one bit each; scores are log-odds of the places."""

    about, sequential = ABOUT, False

    def __init__(self) -> None:
        self.centers = np.empty((0, 128), np.float32)
        self.tree: Tree | None = None

    @property
    def identity(self) -> str:
        if self.tree is None:
            return system_identity(ABOUT)
        tree = self.tree
        learned = arrays_digest(centers=self.centers, parents=tree.parents, marginals=tree.marginals, given=tree.given)
        return system_identity(ABOUT, training=learned)

    def train(self, frames: Iterable[Pixels], seed: int) -> None:
        """Learn the vocabulary, and from its words in the same frames the tree.

        Raises:
            InvalidModel: none has a local feature.
        """
        # The values are whole numbers, so bytes hold them in a quarter of the memory.
        features = [local_features(pixels).astype(np.uint8) for pixels in frames]
        self.centers = train_words(features, V, seed)
        self.tree = chow_liu(np.stack([self.observe(found.astype(np.float32)) for found in features]))

    def observe(self, features: Array) -> Observations:
        """Which words the features of a frame, float32 [T, 128], are nearest to; bool [V]."""
        observed = np.zeros(len(self.centers), np.bool_)
        observed[nearest_words(features, self.centers)] = True
        return observed

    def describe(self, pixels: Pixels) -> Description:
        if self.tree is None:
            raise InvalidModel("fabmap has no words yet; train it on frames first.")
        began = time.perf_counter()
        features = local_features(pixels)
        between = time.perf_counter()
        words = np.packbits(self.observe(features))
        times = {"forward": 1e3 * (between - began), "words": 1e3 * (time.perf_counter() - between)}
        return Description({"words": words}, times)

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        if self.tree is None:
            raise InvalidModel("fabmap has no words yet; train it on frames first.")
        return Places(references, self.tree)


def build(about: About, resources: Resources) -> FabMap:
    resources.refuse_weights(about)
    return FabMap()
