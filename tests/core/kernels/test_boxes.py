"""The compiled sums over boxes are those of equation 3.4, projected or not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from core.method.equations import regional_features
from core.method.projection import Projection
from core.method.regions import box_sums, projected_box_sums

FEW = [[0, 0, 12, 11], [3, 4, 4, 5], [2, 1, 7, 9]]
SMALL = [
    [top, left, top + height, left + width] for top, left, height, width in np.ndindex(3, 3, 5, 5) if height * width
]


@pytest.fixture(params=[[], FEW, FEW * 20, SMALL], ids=["none", "few", "many", "small"])
def boxes(request: pytest.FixtureRequest) -> NDArray[np.int32]:
    """Few large boxes are summed cell by cell, many by a summed-area table, small ones by two cells at a time."""
    return np.array(request.param, np.int32).reshape(-1, 4)


def test_sums(boxes: NDArray[np.int32]) -> None:
    layer = np.random.default_rng(3).random((12, 11, 40)).astype(np.float32)
    np.testing.assert_allclose(box_sums(layer, boxes), regional_features(layer, boxes), rtol=1e-6)


def test_projected_sums(boxes: NDArray[np.int32]) -> None:
    generator = np.random.default_rng(4)
    layer = generator.random((12, 11, 40)).astype(np.float32)
    layer[:3, :3] = 0  # boxes of zeros alone stay zero
    projection = Projection(
        (generator.random(40) / 40).astype(np.float32), generator.standard_normal((40, 9)).astype(np.float32)
    )
    products = projection.products(layer.reshape(-1, 40)).reshape(12, 11, 9)
    made = np.empty((len(boxes), 6), np.float32)
    projected_box_sums(layer, products, boxes, projection.shift, made)
    wanted = projection(regional_features(layer, boxes).astype(np.float32), 6)
    np.testing.assert_allclose(made, wanted, atol=1e-4)
