"""The compiled search for matches of keypoints finds the mutual nearest neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from core.kernels.matching import LAST, mutual_neighbors


def mutual(products: NDArray[np.float32], least: float) -> list[int]:
    """The neighbours of m keypoints in one frame, from products [m, n]; of equal products the lower number."""
    there, back = products.argmax(axis=1), products.argmax(axis=0)
    rows = np.arange(len(products))
    found = (back[there] == rows) & (products[rows, there] > least)
    return np.where(found, there, -1).tolist()


@pytest.mark.parametrize(("ours", "width", "frames"), [(64, 64, 5), (7, 3, 4), (1, 1, 1), (LAST + 1, LAST + 1, 1)])
@pytest.mark.parametrize("highest", [2, 64 * 127**2])
def test_neighbors_are_mutual_and_ties_go_to_the_lower_number(ours: int, width: int, frames: int, highest: int) -> None:
    random = np.random.default_rng(ours + highest)
    products = random.integers(-highest, highest + 1, (ours, frames * width)).astype(np.float32)
    for least in (0, highest // 2):
        found = mutual_neighbors(products, width, least)
        assert found.dtype == np.int32
        wanted = [mutual(products[:, at : at + width], least) for at in range(0, frames * width, width)]
        assert found.tolist() == wanted
