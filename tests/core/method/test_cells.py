"""Cells that lie in several blocks are those that were put there, and nothing beyond a block is ever read."""

from __future__ import annotations

import numpy as np
import pytest

from core.method.agreement import AgreementDefinition, agreement
from core.method.cells import ScatteredCells, in_one_block

ROWS, COLUMNS = 3, 4


def scattered(values: int) -> ScatteredCells:
    random = np.random.default_rng(1)
    blocks = tuple(random.integers(-90, 91, (n, ROWS * COLUMNS, values)).astype(np.int8) for n in (3, 1, 5))
    return ScatteredCells(blocks, np.array([2, 0, 1, 2, 2]), np.array([4, 0, 0, 1, 4]))


def test_together_they_stand_in_order() -> None:
    lying = scattered(8)
    assert lying.shape == (5, ROWS * COLUMNS, 8)
    expected = [lying.blocks[block][row] for block, row in ((2, 4), (0, 0), (1, 0), (2, 1), (2, 4))]
    np.testing.assert_array_equal(lying.together(), expected)
    lying.together()[:] = 0
    assert lying.blocks[2][4].any()


@pytest.mark.parametrize("values", [8, 6, 3])
def test_they_agree_with_a_frame_as_copies_do(values: int) -> None:
    lying = scattered(values)
    stage = AgreementDefinition(layers=("a",), values=values, weights=(1.0,), reach=(1, 2), candidates=5, share=0.8)
    query = lying.blocks[1][0]
    gains = agreement(query, lying, COLUMNS, stage)
    assert gains[2] > gains[0] > 0
    np.testing.assert_array_equal(gains, agreement(query, lying.together(), COLUMNS, stage))
    backwards = lying.together()[::-1]
    np.testing.assert_array_equal(gains[::-1], agreement(query, backwards, COLUMNS, stage))
    query.flags.writeable = False
    np.testing.assert_array_equal(gains, agreement(query, lying, COLUMNS, stage))


def test_addresses_are_those_of_the_blocks() -> None:
    lying = scattered(8)
    size = ROWS * COLUMNS * 8
    assert lying.addresses().tolist() == [
        lying.blocks[block].ctypes.data + row * size for block, row in ((2, 4), (0, 0), (1, 0), (2, 1), (2, 4))
    ]
    nothing = in_one_block(np.empty((0, 4, 8), np.int8))
    assert (len(nothing), nothing.addresses().tolist()) == (0, [])


@pytest.mark.parametrize(("block", "row"), [(0, 3), (1, 1), (2, -1)])
def test_a_row_that_is_not_there_is_refused(block: int, row: int) -> None:
    with pytest.raises(IndexError):
        ScatteredCells(scattered(8).blocks, np.array([0, block]), np.array([0, row])).addresses()


@pytest.mark.parametrize(
    "other", [np.zeros((2, 12, 9), np.int8), np.zeros((2, 12, 16), np.int8)[:, :, ::2], np.zeros((2, 12, 8), np.int16)]
)
def test_blocks_of_another_kind_are_refused(other: np.ndarray) -> None:
    blocks = (np.zeros((2, 12, 8), np.int8), other)
    with pytest.raises(ValueError, match="alike"):
        ScatteredCells(blocks, np.array([0]), np.array([0])).addresses()


def test_grids_that_are_not_alike_are_refused() -> None:
    stage = AgreementDefinition(layers=("a",), values=8, weights=(1.0,), reach=(1, 2), candidates=5, share=0.8)
    for query, columns in (
        (np.zeros((12, 4), np.int8), 4),
        (np.zeros((9, 8), np.int8), 3),
        (np.zeros((12, 8), np.int8), 5),
    ):
        with pytest.raises(ValueError, match="held against"):
            agreement(query, scattered(8), columns, stage)
