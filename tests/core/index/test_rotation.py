"""The rotation keeps inner products, spreads content, and is the same everywhere."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from core.index.rotation import random_signs, rotated


@pytest.mark.parametrize("dimension", [1, 2, 64, 512, 1536, 1000])
def test_inner_products_stay(dimension: int) -> None:
    rows = np.random.default_rng(0).standard_normal((5, dimension)).astype(np.float32)
    turned = rotated(rows, random_signs(dimension, 3))
    assert np.allclose(turned @ turned.T, rows @ rows.T, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("dimension", [512, 1536])
def test_one_value_is_spread_over_all(dimension: int) -> None:
    row = np.zeros((1, dimension), np.float32)
    row[0, 7] = 1
    largest = float(np.abs(rotated(row, random_signs(dimension, 0))).max())
    assert largest < 6 / np.sqrt(dimension)


def test_the_hadamard_transform_of_four_values() -> None:
    """By hand: rows of the matrix ++++, +-+-, ++--, +--+, halved."""
    signs = np.ones((1, 4), np.float32)
    turned = rotated(np.array([[1, 2, 3, 5]], np.float32), signs)
    assert sorted(turned[0].tolist()) == sorted([5.5, -1.5, -2.5, 0.5])


def test_the_rows_given_are_left_as_they_are() -> None:
    rows = np.ones((2, 64), np.float32)
    rotated(rows, random_signs(64, 0))
    assert (rows == 1).all()


def test_signs_are_the_same_on_every_machine() -> None:
    signs = random_signs(4096, 0)
    assert hashlib.sha256(signs.astype(np.int8).tobytes()).hexdigest()[:16] == "77743570653d349c"
    assert not np.array_equal(signs, random_signs(4096, 1))
    assert abs(float(signs.mean())) < 0.05
