"""The compiled VLAD is that of equations 3.7 to 3.11."""

from __future__ import annotations

import numpy as np
import pytest

from core.method.equations import Normalization, vlad
from core.method.vlad import aggregate


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
