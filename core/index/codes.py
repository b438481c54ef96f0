"""One bit a value: codes of descriptors from which their inner products with a query can be estimated.

RaBitQ (Gao and Long, SIGMOD 2024): x is rotated at random, x' = P x, and only the signs s of x' are kept, with one
number.  Since x' lies near s in direction, (‖x'‖² / ‖x'‖₁) <s, P q> estimates <x, q> without bias over rotations; its
error shrinks with the square root of D.  Descriptors of unlike frames are nearly at right angles and their mean is
nearly zero (its length is 0.6, theirs is 7), so nothing is subtracted first, as the paper would.

Most rows need not be looked at so closely.  A *sketch* is a code of 512 bits, made alike of the descriptor's 512
principal values: by it all rows are judged, and the full code is read only of those that come out best.  The principal
values are found in two steps, so that a query is projected in a fraction of a millisecond and without reading a matrix
of 512 x D: the best few directions of every 128 neighbouring values (a word's residual), then the best of all those.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.index.rotation import random_signs, rotated
from core.kernels.codes import GROUP_BITS, GROUP_WORDS, PLANES
from core.threads import keep_numpy_single_threaded

Array = NDArray[np.float32]
Bits = NDArray[np.uint64]

CHUNK = 128
"""Neighbouring values whose principal directions are found together."""
_DIRECTIONS = 2048
"""Directions of all chunks together; of each at least ``_FEWEST``, or all 128."""
_FEWEST = 8
_ITERATIONS, _RIDGE = 4, np.float32(1e-6)
"""Of the search for leading directions; the ridge keeps them apart where the sample has fewer."""
_AT_ONCE = 512
"""Rows coded at a time, so that memory stays bounded."""


@dataclass(frozen=True)
class Codes:
    """Codes of n places, row by row.

    sketches: uint64 [n, S], a short code that every row is first judged by.
    bits: uint64 [n, W], the full code, read only of rows that the short one leaves.
    scales: float32 [n, 2], what turns agreeing bits of the one and of the other into an inner product.

    All three are plain arrays: keep them in a file as they are (little-endian), map them, slice them by row.
    """

    sketches: Bits
    bits: Bits
    scales: Array

    def __len__(self) -> int:
        return len(self.bits)


@dataclass(frozen=True)
class PlaneQuery:
    """A vector in four bits a value, as kernels take it: planes uint64 [groups, 4, 8], step and total."""

    planes: Bits
    step: np.float32
    total: np.float32


@dataclass(frozen=True)
class CodedQuery:
    """A query as codes are compared with it; ``principal``: float32 [512], its unquantised sketch."""

    sketch: PlaneQuery
    code: PlaneQuery
    principal: Array


@dataclass(frozen=True, eq=False)
class Coder:
    """What all codes of a map have in common.  Immutable.

    dimension: D.
    signs: float32 [rounds, D'], of the rotation; D' is D up to the next multiple of 512, zeros being appended.
    within: float32 [D'/128, 128, d], principal directions of each chunk.
    across: float32 [d·D'/128, 512], from those to the sketch's values, a rotation of them included.
    """

    dimension: int
    signs: Array
    within: Array
    across: Array

    @classmethod
    def fitted(cls, sample: Array, seed: int = 0) -> Coder:
        """From some of the map's descriptors, float32 [n, D], n at least 1; 1 000 to 5 000 are enough.

        Raises:
            ValueError: there are none.
        """
        if sample.ndim != 2 or not sample.size:
            raise ValueError("a coder is fitted to at least one descriptor")
        keep_numpy_single_threaded()
        chunks = _chunks(sample)
        directions = min(CHUNK, max(_FEWEST, _DIRECTIONS // len(chunks)))
        within = _principal(np.matmul(chunks.transpose(0, 2, 1), chunks), directions)
        projected = _projected(chunks, within)
        across = _leading(projected.T @ projected, GROUP_BITS, seed)
        turned = rotated(across, random_signs(GROUP_BITS, seed + 1))
        width = len(chunks) * CHUNK
        return cls(sample.shape[1], random_signs(width, seed), within, turned)

    @classmethod
    def of(cls, tensors: Mapping[str, NDArray[Any]]) -> Coder:
        """From what :meth:`tensors` gave.

        Raises:
            ValueError: these are not the tensors of a coder.
        """
        try:
            dimension, signs = int(tensors["dimension"][0]), np.asarray(tensors["signs"], np.float32)
            within, across = (np.ascontiguousarray(tensors[name], np.float32) for name in ("within", "across"))
            width = _width(dimension)
            known = signs.shape == random_signs(width, 0).shape and within.shape[:2] == (width // CHUNK, CHUNK)
            if not known or across.shape != (len(within) * within.shape[2], GROUP_BITS):
                raise ValueError("their shapes do not go together")
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise ValueError(f"these are not the tensors of a coder: {error}") from error
        return cls(dimension, signs, within, across)

    def tensors(self) -> dict[str, NDArray[Any]]:
        """All that makes the coder, to be kept beside its codes (5 MB for D = 16 384)."""
        dimension = np.array([self.dimension], np.int64)
        return {"dimension": dimension, "signs": self.signs, "within": self.within, "across": self.across}

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """S, W and the number of scales of a place."""
        return GROUP_WORDS, _width(self.dimension) // 64, 2

    @property
    def bytes_per_place(self) -> int:
        """In memory: 8 (S + W) + 8."""
        sketch, code, scales = self.shape
        return 8 * (sketch + code) + 4 * scales

    def encode(self, descriptors: Array) -> Codes:
        """Codes of descriptors, float32 [n, D].

        Each depends on its own row alone, but for bits of values that are zero within float32 rounding.

        Raises:
            ValueError: they have another number of values.
        """
        self._check(descriptors)
        sketch, code, scales = self.shape
        n = len(descriptors)
        made = Codes(
            np.empty((n, sketch), np.uint64), np.empty((n, code), np.uint64), np.empty((n, scales), np.float32)
        )
        for start in range(0, n, _AT_ONCE):
            rows = slice(start, start + _AT_ONCE)
            padded = _padded(descriptors[rows])
            made.sketches[rows], made.scales[rows, 0] = _signs_and_scales(self.principal(descriptors[rows]))
            made.bits[rows], made.scales[rows, 1] = _signs_and_scales(rotated(padded, self.signs))
        return made

    def nothing(self, n: int) -> Codes:
        """Of ``n`` rows that have no descriptor any more, and are never asked for."""
        sketch, code, scales = self.shape
        return Codes(
            np.zeros((n, sketch), np.uint64), np.zeros((n, code), np.uint64), np.zeros((n, scales), np.float32)
        )

    def query(self, descriptor: Array) -> CodedQuery:
        """A query, float32 [D].

        Raises:
            ValueError: it has another number of values.
        """
        self._check(descriptor[np.newaxis])
        padded = _padded(descriptor[np.newaxis])
        principal = self.principal(descriptor[np.newaxis])[0]
        return CodedQuery(_planes(principal), _planes(rotated(padded, self.signs)[0]), principal)

    def principal(self, descriptors: Array) -> Array:
        """The values whose signs make the sketch: float32 [n, D] to [n, 512].

        Raises:
            ValueError: the descriptors have another number of values.
        """
        self._check(descriptors)
        return np.asarray(_projected(_chunks(descriptors), self.within) @ self.across, np.float32)

    def _check(self, descriptors: Array) -> None:
        if descriptors.ndim != 2 or descriptors.shape[1] != self.dimension:
            raise ValueError(f"this coder is for descriptors of {self.dimension} values")


def _width(dimension: int) -> int:
    """D'."""
    return -(-dimension // GROUP_BITS) * GROUP_BITS


def _padded(vectors: Array) -> Array:
    """float32 [n, D], zeros appended: [n, D']."""
    missing = _width(vectors.shape[1]) - vectors.shape[1]
    return np.pad(vectors, ((0, 0), (0, missing))) if missing else vectors


def _chunks(vectors: Array) -> Array:
    """float32 [n, D] as [D'/128, n, 128]."""
    padded = _padded(np.asarray(vectors, np.float32))
    return padded.reshape(len(padded), -1, CHUNK).transpose(1, 0, 2)


def _projected(chunks: Array, within: Array) -> Array:
    """float32 [c, n, 128] by [c, 128, d]: [n, c·d]."""
    found = np.matmul(chunks, within)
    return np.ascontiguousarray(found.transpose(1, 0, 2)).reshape(chunks.shape[1], -1)


def _principal(moments: Array, count: int) -> Array:
    """The ``count`` eigenvectors of the largest eigenvalues, as columns; float32 [..., k, k] to [..., k, count]."""
    vectors = np.linalg.eigh(moments)[1]
    return np.ascontiguousarray(vectors[..., ::-1][..., :count], np.float32)


def _leading(moment: Array, count: int, seed: int) -> Array:
    """An orthonormal basis, [k, count], of about the space of those eigenvectors of a large matrix, [k, k].

    Simultaneous iteration (Halko, Martinsson and Tropp, SIAM Review 53(2), 2011): the basis is rotated at random
    afterwards, so only the space matters, and values that it misses by a little are hardly less than those it has.
    """
    basis = np.random.default_rng(seed).standard_normal((len(moment), count)).astype(np.float32)
    for _ in range(_ITERATIONS):
        basis = np.linalg.qr(moment @ basis + _RIDGE * basis)[0]
    return np.asarray(basis, np.float32)


def _signs_and_scales(values: Array) -> tuple[Bits, Array]:
    """uint64 [n, D'/64], a one for each positive value, and ‖x'‖² / ‖x'‖₁, float32 [n], 0 for a row of zeros."""
    packed = np.packbits(values > 0, axis=1, bitorder="little").view("<u8").astype(np.uint64, copy=False)
    squares = np.einsum("nk,nk->n", values, values)
    sums = np.abs(values).sum(axis=1)
    return packed, np.divide(squares, sums, out=np.zeros_like(sums), where=sums > 0)


def _planes(values: Array) -> PlaneQuery:
    """Four bits a value, in steps of a seventh of the largest."""
    step = np.float32(np.abs(values).max() / (2 ** (PLANES - 1) - 1))
    levels = np.rint(values / step).astype(np.int8) if step > 0 else np.zeros(len(values), np.int8)
    bits = levels.view(np.uint8)[np.newaxis] >> np.arange(PLANES, dtype=np.uint8)[:, np.newaxis] & 1
    words = np.packbits(bits, axis=1, bitorder="little").view("<u8").astype(np.uint64, copy=False)
    planes = np.ascontiguousarray(words.reshape(PLANES, -1, GROUP_WORDS).transpose(1, 0, 2))
    # <s, q> = 2 Σ q where s is one - Σ q.
    return PlaneQuery(planes, np.float32(2 * step), np.float32(step * levels.sum(dtype=np.int64)))
