"""Comparisons of whole blocks against the same, value by value."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.kernels.bit_masks import BLOCK, lowest_bit, reaching, set_bits


@numba.njit
def block_of(values, start, threshold):  # type: ignore[no-untyped-def]
    return reaching(values, start, threshold)


@numba.njit
def places(bits):  # type: ignore[no-untyped-def]
    return lowest_bit(bits), set_bits(bits)


def values_of(seed: int, count: int) -> NDArray[np.float32]:
    # Quarters: many are just at the threshold.
    return np.asarray(np.random.default_rng(seed).integers(-8, 9, count) / 4, np.float32)


@pytest.mark.parametrize("start", [0, 1, 13, 100 - BLOCK])
@pytest.mark.parametrize("threshold", [-5.0, 0.0, 0.25, 1.75, 5.0])
def test_each_bit_says_whether_its_value_reaches_the_threshold(start: int, threshold: float) -> None:
    values = values_of(start, 100)
    bits = int(block_of(values, start, np.float32(threshold)))
    assert [bool(bits >> i & 1) for i in range(BLOCK)] == (values[start : start + BLOCK] >= threshold).tolist()


def test_what_is_not_a_number_reaches_nothing() -> None:
    values = np.full(BLOCK, np.nan, np.float32)
    values[3] = np.inf
    assert int(block_of(values, 0, np.float32(0))) == 1 << 3


@settings(deadline=None)  # the first call compiles
@given(st.integers(1, 2**64 - 1))
def test_the_lowest_bit_and_how_many_there_are(bits: int) -> None:
    lowest, count = places(np.uint64(bits))
    assert (int(lowest), int(count)) == ((bits & -bits).bit_length() - 1, bits.bit_count())
