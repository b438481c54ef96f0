"""SeqSLAM: tiny patch-normalized frames matched in sequences, along paths of nearly constant velocity.

Milford, Wyeth: SeqSLAM: Visual Route-based Navigation for Sunny Summer Days and Stormy Winter Nights, ICRA
2012.  Constants and the form of the score are those of OpenSeqSLAM (Sünderhauf, 2013).  As there, the
sequence of a query has the query in the middle: half of it lies ahead, which a moving robot would have to wait for.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels
from lab.baselines.system import About, Array, Constants, Description, ReferenceIndex, Resources, stack, system_identity

R_X, R_Y = 64, 32
P = 8
R_LOCAL = 10
D_S = 10
V_MIN, V_MAX = 0.8, 1.2
R_WINDOW = 10
CONSTANTS: Constants = {
    "R_x": R_X,
    "R_y": R_Y,
    "P": P,
    "R_local": R_LOCAL,
    "d_s": D_S,
    "v_min": V_MIN,
    "v_max": V_MAX,
    "R_window": R_WINDOW,
}
ABOUT = About(
    "seqslam",
    "SeqSLAM",
    "Milford, Wyeth: SeqSLAM: Visual Route-based Navigation for Sunny Summer Days and Stormy Winter Nights, ICRA 2012",
    CONSTANTS,
)


def patch_normalize(grey: NDArray[np.uint8]) -> Array:
    """Each P x P patch less its mean, over its standard deviation; a flat patch becomes zero.

    Args:
        grey: uint8 [H, W], both multiples of P.

    Returns:
        float32 [H, W].
    """
    height, width = grey.shape
    patches = grey.astype(np.float32).reshape(height // P, P, width // P, P)
    centred = patches - patches.mean(axis=(1, 3), keepdims=True)
    deviations = patches.std(axis=(1, 3), keepdims=True, ddof=1)
    scaled = np.divide(centred, deviations, out=np.zeros_like(centred), where=deviations > 0)
    return scaled.reshape(height, width)


def differences(queries: Array, references: Array) -> Array:
    """Mean absolute difference of each pair: float32 [Q, D] and [R, D] to [Q, R]."""
    from scipy.spatial.distance import cdist

    return np.asarray(cdist(queries, references, "cityblock") / queries.shape[1], np.float32)


def enhance_contrast(matrix: Array) -> Array:
    """Each difference less the mean of those to the references around it, over their deviation.

    The neighbourhood is R_local / 2 references to both sides, cut at the ends of the traverse.

    Args:
        matrix: float32 [Q, R].

    Returns:
        float32 [Q, R], the least of all 0.
    """
    count, half = matrix.shape[1], R_LOCAL // 2
    first = np.maximum(0, np.arange(count) - half)
    last = np.minimum(count, np.arange(count) + half + 1)
    sizes = last - first
    sums, squares = (
        np.pad(np.cumsum(values, axis=1), ((0, 0), (1, 0)))
        for values in (matrix.astype(np.float64), matrix.astype(np.float64) ** 2)
    )
    means = (sums[:, last] - sums[:, first]) / sizes
    spread = (squares[:, last] - squares[:, first]) - sizes * means**2
    deviations = np.sqrt(np.maximum(spread, 0) / np.maximum(sizes - 1, 1))
    enhanced = np.divide(matrix - means, deviations, out=np.zeros(matrix.shape), where=deviations > 1e-9)
    return np.asarray(enhanced - enhanced.min(), np.float32)


def path_costs(matrix: Array) -> Array:
    """The least mean difference along the paths through each cell, over velocities from v_min to v_max.

    A path goes d_s / 2 queries back and ahead, as far as there are queries; where it leaves the references it
    stays with the last one.

    Args:
        matrix: float32 [Q, R].

    Returns:
        float32 [Q, R].
    """
    queries, references = matrix.shape
    half, cells = D_S // 2, np.arange(references)
    # Paths differ only where velocities differ by at least 1 / d_s.
    velocities = np.arange(round(V_MIN * D_S), round(V_MAX * D_S) + 1) / D_S
    least = np.full(matrix.shape, np.inf, np.float32)
    for velocity in velocities:
        total, steps = np.zeros(matrix.shape, np.float32), np.zeros((queries, 1), np.float32)
        for step in range(-half, half + 1):
            rows = slice(max(0, -step), min(queries, queries - step))
            beside = slice(rows.start + step, rows.stop + step)
            if rows.start >= rows.stop:
                continue
            reached = np.clip(cells + int(np.floor(velocity * step + 0.5)), 0, references - 1)
            total[rows] += matrix[beside][:, reached]
            steps[rows] += 1
        np.minimum(least, total / steps, out=least)
    return least


def distinctness(costs: Array) -> Array:
    """Least cost more than R_window / 2 references from a query's best one, over each cost; over 1 is distinct.

    This is the inverse of OpenSeqSLAM's measure of a match, for every reference; it keeps the order within a row.

    Args:
        costs: float32 [Q, R], not negative.

    Returns:
        float32 [Q, R].
    """
    far = np.abs(np.arange(costs.shape[1]) - costs.argmin(axis=1)[:, None]) > R_WINDOW // 2
    # On a short traverse nothing may be that far away; then the worst cost is used.
    rival = np.where(far, costs, np.inf).min(axis=1, keepdims=True)
    rival = np.where(np.isfinite(rival), rival, costs.max(axis=1, keepdims=True))
    least = np.float32(1e-6)  # a path may cost nothing
    return np.asarray((rival + least) / (costs + least), np.float32)


class Sequences:
    """References in the order of their traverse."""

    def __init__(self, references: Sequence[Description]) -> None:
        self._patches = stack(references, "patches")

    def score(self, queries: Sequence[Description]) -> Array:
        matrix = enhance_contrast(differences(stack(queries, "patches"), self._patches))
        return distinctness(path_costs(matrix))


class SeqSlam:
    """Downsampled, patch-normalized frames, scored as one sequence."""

    about, sequential = ABOUT, True

    def __init__(self) -> None:
        self.identity = system_identity(ABOUT)

    def describe(self, pixels: Pixels) -> Description:
        began = time.perf_counter()
        grey = cv2.resize(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), (R_X, R_Y), interpolation=cv2.INTER_AREA)
        patches = patch_normalize(np.asarray(grey, np.uint8)).reshape(-1)
        return Description({"patches": patches}, {"forward": 1e3 * (time.perf_counter() - began)})

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return Sequences(references)


def build(about: About, resources: Resources) -> SeqSlam:
    resources.refuse_weights(about)
    return SeqSlam()
