"""The frozen reference is a true one: it finds what the region pass finds."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.thesis.reference_regions import reference_regions
from core.method.regions import extract_regions


@pytest.mark.parametrize("count", [3, 40, 10_000])
def test_both_find_the_same_regions(count: int) -> None:
    random = np.random.default_rng(count)
    activations = np.maximum(0, random.normal(0.3, 1.0, (9, 7, 12))).astype(np.float32)  # X x Y x K

    ours = extract_regions([activations], [0.5], count)
    boxes, energies, features = reference_regions(activations.transpose(2, 0, 1), 0.5, count)

    assert len(ours) == len(boxes) > 0
    np.testing.assert_array_equal(ours.boxes, boxes)
    np.testing.assert_allclose(ours.energies, energies, rtol=1e-5)
    np.testing.assert_allclose(ours.features, features, rtol=1e-4, atol=1e-4)
