"""Products with packed descriptors are those with the descriptors unpacked by plain arithmetic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.kernels.packed import BLOCK, packed_products


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32), st.integers(0, 6), st.integers(1, 5))
def test_products_are_those_of_the_values_meant(seed: int, rows: int, blocks: int) -> None:
    random = np.random.default_rng(seed)
    values = random.integers(0, 64, (rows, blocks * BLOCK))
    scales = random.random((rows, blocks), dtype=np.float32)
    upper, lower = (values >> 2).astype(np.uint8), (values & 3).astype(np.uint8)
    uppers = (upper[:, ::2] | upper[:, 1::2] << 4).astype(np.uint8)
    lowers = (lower[:, ::4] | lower[:, 1::4] << 2 | lower[:, 2::4] << 4 | lower[:, 3::4] << 6).astype(np.uint8)
    query = random.standard_normal(blocks * BLOCK).astype(np.float32)
    meant = (values - 32.0) * np.repeat(scales, BLOCK, axis=1)
    assert packed_products(query, scales, uppers, lowers) == pytest.approx(meant @ query, rel=1e-4, abs=2e-3)


def test_rows_may_lie_apart() -> None:
    random = np.random.default_rng(0)
    kept = random.integers(0, 256, (7, 300), dtype=np.uint8)
    scales, query = np.ones((7, 2), np.float32), random.standard_normal(256).astype(np.float32)
    apart = packed_products(query, scales, kept[:, 10:138], kept[:, 200:264])
    together = packed_products(query, scales, kept[:, 10:138].copy(), kept[:, 200:264].copy())
    assert np.array_equal(apart, together)
