"""Local descriptors of several frames, where they lie in memory: what is compared once need not be copied first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Cells = NDArray[np.int8]


@dataclass(frozen=True)
class ScatteredCells:
    """Of k frames, C cells of L values each.

    blocks: int8 [n, C, L] each, contiguous; at least one.
    block: int64 [k], in which of the blocks a frame's cells are.
    row: int64 [k], and which of its n they are.
    """

    blocks: tuple[Cells, ...]
    block: NDArray[np.int64]
    row: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.row)

    @property
    def shape(self) -> tuple[int, ...]:
        """k, C and L."""
        return len(self), *self.blocks[0].shape[1:]

    def together(self) -> Cells:
        """A copy: int8 [k, C, L]."""
        found = np.empty(self.shape, np.int8)
        for position, (block, row) in enumerate(zip(self.block.tolist(), self.row.tolist(), strict=True)):
            found[position] = self.blocks[block][row]
        return found

    def addresses(self) -> NDArray[np.int64]:
        """Of the first value of each frame, int64 [k]; good as long as this object lives.

        Raises:
            IndexError: a block has no such row.
            ValueError: a block is not contiguous, or has another shape.
        """
        lengths = np.array([len(block) for block in self.blocks])
        if len(self) and (self.row.min() < 0 or (self.row >= lengths[self.block]).any()):
            raise IndexError("a block of cells has no such row")
        for block in self.blocks:
            if block.shape[1:] != self.shape[1:] or block.dtype != np.int8 or not block.flags.c_contiguous:
                raise ValueError("blocks of cells are alike and contiguous")
        firsts = np.array([block.ctypes.data for block in self.blocks], np.int64)
        return np.asarray(firsts[self.block] + self.row * int(np.prod(self.shape[1:])))


def in_one_block(cells: Cells) -> ScatteredCells:
    """Cells that lie together: int8 [k, C, L], copied only where they are not contiguous."""
    count = len(cells)
    return ScatteredCells((np.ascontiguousarray(cells, np.int8),), np.zeros(count, np.int64), np.arange(count))
