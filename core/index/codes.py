"""One bit a value: codes of descriptors from which their inner products with a query are estimated.

FAISS rotates a descriptor at random (``HadamardRotation``: random signs and fast Hadamard transforms, seeded) and keeps
the signs of the result and two numbers (``IndexRaBitQ``: Gao and Long, SIGMOD 2024).  The estimate is without bias over
rotations, and its error shrinks with the square root of the number of values.  Descriptors of unlike frames are nearly
at right angles and their mean is nearly zero, so nothing is subtracted first, as the paper would; hence a code depends
on its own descriptor alone, and nothing has to be learnt from the map.
"""

from __future__ import annotations

import zlib
from functools import cache, cached_property

import faiss
import numpy as np
from numpy.typing import NDArray

from core.index.flat import Array, in_one_thread

Codes = NDArray[np.uint8]
"""Codes of n places, uint8 [n, bytes], as FAISS's IndexRaBitQ stores them."""

SEED = 12345
"""Of the rotation."""

QUERY_BITS = 2
"""Bits in which a rotated query keeps a value where it is compared with codes: more find no more, and take longer."""

_AT_ONCE = 256
"""Rows that are coded at a time, so that memory stays bounded."""


class Coder:
    """Makes codes of descriptors of one length, D.  Any thread may use it."""

    def __init__(self, dimension: int) -> None:
        """For descriptors of D values."""
        self.dimension = dimension
        self._rotation = faiss.HadamardRotation(dimension, SEED)
        self.width: int = self._rotation.d_out
        """D', the values of a rotated descriptor: the least power of two that is no less than D."""
        self._empty = self.index(0)
        self.bytes_per_place: int = self._empty.code_size

    @staticmethod
    @cache
    def of(dimension: int) -> Coder:
        """The coder of descriptors of D values."""
        return Coder(dimension)

    def index(self, capacity: int) -> faiss.IndexRaBitQ:
        """An index with room for this number of codes, to be filled through :func:`core.index.flat.stored`."""
        index = faiss.IndexRaBitQ(self.width, faiss.METRIC_INNER_PRODUCT)
        index.train(np.zeros((1, self.width), np.float32))  # the mean that is subtracted
        index.qb, index.centered = QUERY_BITS, True
        index.codes.resize(capacity * index.code_size)
        index.ntotal = capacity
        return index

    def rotated(self, descriptors: Array) -> Array:
        """Descriptors or queries, float32 [n, D], as codes are compared with them: float32 [n, D'].

        Raises:
            ValueError: they have another number of values.
        """
        if descriptors.ndim != 2 or descriptors.shape[1] != self.dimension:
            raise ValueError(f"this coder is for descriptors of {self.dimension} values")
        if not len(descriptors):
            return np.empty((0, self.width), np.float32)
        with in_one_thread():
            turned: Array = self._rotation.apply(np.ascontiguousarray(descriptors, np.float32))
        return turned

    def encode(self, descriptors: Array) -> Codes:
        """Codes of descriptors, float32 [n, D]; each depends on its own row alone.

        Raises:
            ValueError: they have another number of values.
        """
        parts = [self.blank(0)]
        for start in range(0, max(1, len(descriptors)), _AT_ONCE):
            if len(turned := self.rotated(descriptors[start : start + _AT_ONCE])):
                with in_one_thread():
                    parts.append(self._empty.sa_encode(turned))
        return np.concatenate(parts)

    def blank(self, n: int) -> Codes:
        """Codes for ``n`` rows that have no descriptor any more and are never read; an empty array for 0 rows."""
        return np.zeros((n, self.bytes_per_place), np.uint8)

    def decoded(self, codes: Codes, count: int) -> Array:
        """The first ``count`` rotated values, a multiple of eight, as codes keep them: float32 [n, count].

        FAISS's own decoder, which says the same, would take all values one by one.
        """
        signs = np.unpackbits(codes[:, : count // 8], axis=1, bitorder="little").astype(np.float32)
        _, lengths = np.ascontiguousarray(codes[:, self.width // 8 :]).view("<f4").T
        return (2 * signs - 1) * (lengths / np.float32(np.sqrt(self.width)))[:, np.newaxis]

    @cached_property
    def digest(self) -> str:
        """The fingerprint of the rotation and layout of the codes: a CRC-32 of the signs of a known code."""
        known = np.random.default_rng(0).standard_normal((1, self.dimension)).astype(np.float32)
        return f"{zlib.crc32(self.encode(known)[0, : self.width // 8].tobytes()):08x}"
