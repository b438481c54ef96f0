from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from core.maps.forms import (
    BLOCK,
    inner_products,
    pack_descriptors,
    pack_local,
    resting_types,
    unpack_descriptors,
    unpack_local,
)
from core.maps.records import Precision
from tests.core.store.frames import descriptor_of, local_of

PRECISIONS: tuple[Precision, ...] = ("half", "compressed")


def descriptors(count: int, dimension: int) -> NDArray[np.float32]:
    return np.array([descriptor_of(str(row), dimension) for row in range(count)])


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("dimension", [1, 16, BLOCK, BLOCK + 1, 1000])
def test_stored_values_have_the_types_of_a_record(precision: Precision, dimension: int) -> None:
    kept = pack_descriptors(descriptors(3, dimension), precision)
    (dtype, shape), _ = resting_types(precision, dimension, (3, 5))
    assert (kept.dtype, kept.shape) == (np.dtype(dtype), (3, *shape))
    back = unpack_descriptors(kept, precision, dimension)
    assert (str(back.dtype), back.shape) == ("float32", (3, dimension))


@pytest.mark.parametrize(("precision", "bound"), [("half", 2.0**-11), ("compressed", 1 / 61.9)])
def test_no_value_is_off_by_more_than_half_a_step(precision: Precision, bound: float) -> None:
    """Of halves a step is 2^-10 of the value, of compressed values a thirty-first of the largest of their block."""
    given = descriptors(5, 1024)
    error = np.abs(unpack_descriptors(pack_descriptors(given, precision), precision, 1024) - given)
    blocks = np.abs(given).reshape(5, -1, BLOCK).max(axis=2).repeat(BLOCK, axis=1)
    assert (error <= bound * (blocks if precision == "compressed" else np.abs(given)) + 1e-7).all()


def test_zeros_stay_zeros_and_signs_signs() -> None:
    given = descriptors(2, 3 * BLOCK)
    given[:, BLOCK : 2 * BLOCK] = 0
    back = unpack_descriptors(pack_descriptors(given, "compressed"), "compressed", 3 * BLOCK)
    assert not back[:, BLOCK : 2 * BLOCK].any()
    assert (back * given >= 0).all()


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("shape", [(3, 5), (4, 8), (0, 0)])
def test_local_descriptors_come_back(precision: Precision, shape: tuple[int, int]) -> None:
    given = np.array([local_of(str(row), shape) for row in range(4)])
    kept = pack_local(given, precision)
    _, (dtype, kept_shape) = resting_types(precision, 8, shape)
    assert (kept.dtype, kept.shape) == (np.dtype(dtype), (4, *kept_shape))
    back = unpack_local(kept, precision, shape)
    assert (str(back.dtype), back.shape) == ("int8", given.shape)
    if precision != "compressed":
        np.testing.assert_array_equal(back, given)
    elif given.size:
        steps = np.ceil(np.abs(given.astype(int)).max(axis=2, keepdims=True) / 7)
        assert (np.abs(back.astype(int) - given) <= steps / 2 + 1).all()


def test_small_local_values_are_stored_exactly() -> None:
    given = np.arange(-7, 8, dtype=np.int8).reshape(1, 3, 5)
    np.testing.assert_array_equal(unpack_local(pack_local(given, "compressed"), "compressed", (3, 5)), given)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("queries", [1, 7])
@pytest.mark.parametrize("count", [0, 1, 40])
def test_inner_products_are_those_of_the_stored_values(precision: Precision, queries: int, count: int) -> None:
    asked = np.array([descriptor_of(f"query {i}", 300) for i in range(queries)])
    kept = pack_descriptors(descriptors(count, 300).reshape(count, 300), precision)
    expected = asked @ unpack_descriptors(kept, precision, 300).T
    found = inner_products(asked, kept, precision)
    assert (str(found.dtype), found.shape) == ("float32", (queries, count))
    np.testing.assert_allclose(found, expected, atol=1e-6)
