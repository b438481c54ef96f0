"""Products with packed descriptors are those with the descriptors unpacked by plain arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.kernels.packed import BLOCK, packed_products

SPACING = float(np.finfo(np.float32).eps)


def apart(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The same rows as a part of wider ones, as they lie in a file that holds more of each descriptor."""
    return np.pad(rows, [(0, 0), (10, 7)])[:, 10:-7]


@pytest.mark.parametrize("contiguous", [True, False])
@settings(max_examples=20)
@given(seed=st.integers(0, 2**32), rows=st.integers(0, 6), blocks=st.integers(1, 5))
def test_products_are_those_of_the_values_meant(contiguous: bool, seed: int, rows: int, blocks: int) -> None:
    random = np.random.default_rng(seed)
    values = random.integers(0, 64, (rows, blocks * BLOCK))
    scales = random.random((rows, blocks), dtype=np.float32)
    upper, lower = (values >> 2).astype(np.uint8), (values & 3).astype(np.uint8)
    uppers = (upper[:, ::2] | upper[:, 1::2] << 4).astype(np.uint8)
    lowers = (lower[:, ::4] | lower[:, 1::4] << 2 | lower[:, 2::4] << 4 | lower[:, 3::4] << 6).astype(np.uint8)
    query = random.standard_normal(blocks * BLOCK).astype(np.float32)
    made = (
        packed_products(query, scales, uppers, lowers)
        if contiguous
        else packed_products(query, scales, apart(uppers), apart(lowers))
    )
    scale = np.repeat(scales.astype(np.float64), BLOCK, axis=1)
    meant = (scale * (values - 32.0)) @ query.astype(np.float64)
    # A float32 sum of n terms, in whatever order, is off by at most n half spacings of the sum of their magnitudes.
    magnitudes = (scale * (values + 32.0)) @ np.abs(query).astype(np.float64)
    assert (np.abs(made - meant) <= len(query) * SPACING * magnitudes).all()
