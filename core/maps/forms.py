"""The forms in which the descriptors of a map are stored.

half        descriptors in half precision, local descriptors without change
compressed  descriptors in six bits per value with a scale per block of 128 values, local descriptors in four bits per
            value with a step per cell: 29 KB instead of 98 KB with the default encoder

Intra-normalised VLADs and unit vectors have values within [-1, 1], most of them near 1 / 128 (D = 16 384), which half
precision represents with 11 bits.  Searches and comparisons use what is stored, converted back to float32 and int8.
``python -m benchmarks.maps.precision`` measures the cost of each format.

FAISS's six bits (``QT_6bit``) do not replace the compressed format.  A stored row may not depend on a later one, so
their ranges must be fixed: at ±1 the descriptors of lip6 have an error of 0.104 where ours have 0.018, and the first
stage finds another best place for 13 of 455 queries where ours finds it for 2; by the first 100 rows it is 0.086 and
21; by a scale a row 0.024 and 5, and with ``m-region-vlad-thesis`` on corridor 0.041 where ours have 0.027.  With our
scale a block the error is ours, but FAISS unpacks all blocks before it multiplies: 2.7 ms for 100 rows, and ours 0.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.index.flat import Vectors, flat_index, products, vectors
from core.kernels.packed import packed_products
from core.maps.records import MapRecord, Precision

Descriptor = NDArray[np.float32]
Local = NDArray[np.int8]
"""Local descriptors of one frame, [C, L]; [0, 0] where the encoder has no second stage."""

NO_LOCAL = (0, 0)
"""Shape of the local descriptors of an encoder that has none."""

HALF: Precision = "half"
COMPRESSED: Precision = "compressed"

BLOCK = 128
"""Values of a compressed descriptor that share a scale: those of one visual word of the default encoder."""

_HIGHEST = (
    31  # six bits hold -31 to 31 as 1 to 63; a byte holds the upper four bits of two values or the lower two of four
)
_HIGHEST_LOCAL = 7  # four bits hold -7 to 7 as 1 to 15; a byte holds two values

_BYTES = np.arange(256)
_HALVES = np.stack([_BYTES % 16, _BYTES // 16], axis=1)
_QUARTERS = np.stack([_BYTES >> shift & 3 for shift in (0, 2, 4, 6)], axis=1)
_UPPER = (4 * _HALVES - 32).astype(np.float32)
_LOWER = _QUARTERS.astype(np.float32)
_LOCAL = (_HALVES - 8).astype(np.int8)

_FEW_QUERIES = 4  # for more queries it is faster to unpack the rows once

Field = tuple[str, tuple[int, ...]]
"""Type and shape of a field of a record."""


def resting_types(precision: Precision, dimension: int, local_shape: tuple[int, int]) -> tuple[Field, Field]:
    """The fields that hold a descriptor of D values and local descriptors of shape (C, L)."""
    if precision == COMPRESSED:
        cells, values = local_shape
        blocks = -(-dimension // BLOCK)
        return ("u1", (blocks * (2 + BLOCK // 2 + BLOCK // 4),)), ("u1", (cells * (1 + -(-values // 2)),))
    return ("<f2", (dimension,)), ("i1", local_shape)


def pack_descriptors(descriptors: NDArray[np.float32], precision: Precision) -> NDArray[Any]:
    """Convert descriptors, float32 [n, D], to their stored form, [n, …]; halves are rounded to nearest, ties even."""
    if precision == HALF:
        return descriptors.astype("<f2")
    n, dimension = descriptors.shape
    count = -(-dimension // BLOCK)
    blocks = _whole_blocks(descriptors).reshape(n, count, BLOCK)
    # The scale is rounded up, so that no value exceeds it; that of a block of zeros does not matter.
    scales = np.nextafter((np.abs(blocks).max(axis=2) / _HIGHEST).astype("<f2"), np.float16(np.inf)).astype("<f2")
    values = np.rint(blocks / scales[:, :, np.newaxis].astype(np.float32)).reshape(n, count * BLOCK)
    codes = (np.clip(values, -_HIGHEST, _HIGHEST) + 32).astype(np.uint8)
    lower = codes & 3
    quarters = lower[:, ::4] | lower[:, 1::4] << 2 | lower[:, 2::4] << 4 | lower[:, 3::4] << 6
    return np.concatenate([scales.view(np.uint8), _paired(codes >> 2), quarters], axis=1)


def _whole_blocks(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pad vectors, float32 [n, D], with zeros to a whole number of blocks; without need they are not copied."""
    missing = -vectors.shape[1] % BLOCK
    return np.pad(vectors, ((0, 0), (0, missing))) if missing else vectors


def _paired(codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pack numbers below 16 two per byte; the length of the last axis is even."""
    return np.asarray(codes[..., ::2] | codes[..., 1::2] << 4)


def unpack_descriptors(stored: NDArray[Any], precision: Precision, dimension: int) -> NDArray[np.float32]:
    """Convert descriptors back from the form that :func:`pack_descriptors` gave: float32 [n, D]."""
    if precision != COMPRESSED:
        return np.ascontiguousarray(stored, dtype=np.float32)
    n, count = len(stored), -(-dimension // BLOCK)
    scales, pairs, quarters = _parts_of(stored, dimension)
    values = _UPPER[pairs].reshape(n, count * BLOCK)
    values += _LOWER[quarters].reshape(n, count * BLOCK)
    blocks = values.reshape(n, count, BLOCK)
    blocks *= scales[:, :, np.newaxis]
    return np.ascontiguousarray(values[:, :dimension])


def _parts_of(stored: NDArray[Any], dimension: int) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]:
    """The scales, float32 [n, blocks], the upper four bits of values (two a byte) and the lower two (four a byte)."""
    count = -(-dimension // BLOCK)
    scales = np.ascontiguousarray(stored[:, : 2 * count]).view("<f2").astype(np.float32)
    return scales, stored[:, 2 * count : (2 + BLOCK // 2) * count], stored[:, (2 + BLOCK // 2) * count :]


def pack_local(local: Local, precision: Precision) -> NDArray[Any]:
    """Convert local descriptors, int8 [n, C, L], to their stored form, [n, …]; each cell gets its smallest step."""
    if precision != COMPRESSED:
        return local
    n = len(local)
    if not local.size:
        return np.empty((n, 0), np.uint8)
    real = np.pad(local.astype(np.float32), ((0, 0), (0, 0), (0, local.shape[2] % 2)))
    steps = np.maximum(1, np.ceil(np.abs(real).max(axis=2) / _HIGHEST_LOCAL)).astype(np.uint8)
    pairs = _paired((np.rint(real / steps[:, :, np.newaxis]) + 8).astype(np.uint8))
    return np.concatenate([steps, pairs.reshape(n, -1)], axis=1)


def unpack_local(stored: NDArray[Any], precision: Precision, local_shape: tuple[int, int]) -> Local:
    """Convert local descriptors back from the form that :func:`pack_local` gave: int8 [n, C, L]."""
    if precision != COMPRESSED:
        return np.ascontiguousarray(stored)
    n, (cells, values) = len(stored), local_shape
    if not cells:
        return np.empty((n, *local_shape), np.int8)
    steps, pairs = stored[:, :cells].astype(np.int16), stored[:, cells:]
    real = _LOCAL[pairs].reshape(n, cells, 2 * -(-values // 2))[:, :, :values] * steps[:, :, np.newaxis]
    return np.clip(real, -127, 127).astype(np.int8)


def inner_products(queries: NDArray[np.float32], stored: NDArray[Any], precision: Precision) -> NDArray[np.float32]:
    """Inner products of queries, float32 [B, D], with descriptors in their stored form, [k, …]: float32 [B, k].

    Every product is summed in float32.
    """
    rows, dimension = len(stored), queries.shape[1]
    if precision == COMPRESSED:
        if len(queries) > _FEW_QUERIES:
            return np.asarray(queries @ unpack_descriptors(stored, precision, dimension).T)
        scales, uppers, lowers = _parts_of(stored, dimension)
        made = [packed_products(query, scales, uppers, lowers) for query in _whole_blocks(queries)]
        return np.array(made, np.float32).reshape(len(queries), rows)
    index = flat_index(rows, dimension, precision == HALF)
    vectors(index)[:] = stored
    return products(index, queries)


class Form:
    """The stored form of the descriptors of one map.

    frame: the structured type of both of one frame, as an export file has them.
    """

    def __init__(self, precision: Precision, dimension: int, local_shape: tuple[int, int]) -> None:
        """For descriptors of D values and local descriptors of shape (C, L).

        Raises:
            ValueError: numpy has no type for them.
        """
        if local_shape != NO_LOCAL and min(local_shape) < 1:
            raise ValueError(f"local descriptors cannot have {local_shape} cells and values")
        self.dimension, self.local_shape, self.precision = dimension, local_shape, precision
        descriptor, local = resting_types(precision, dimension, local_shape)
        self.frame = np.dtype([("descriptor", *descriptor), ("local", *local)])
        self._descriptor, self._local = (np.dtype([("stored", *one)]) for one in (descriptor, local))

    @classmethod
    def of(cls, record: MapRecord) -> Form:
        """That of the map with a record."""
        return cls(record.precision, record.dimension, record.local_shape)

    def packed(self, descriptor: Descriptor, local: Local) -> tuple[bytes, bytes]:
        """The stored form of a descriptor, float32 [D], and of local descriptors, int8 [C, L]."""
        packed = pack_descriptors(descriptor[np.newaxis], self.precision)[0]
        return packed.tobytes(), pack_local(local[np.newaxis], self.precision)[0].tobytes()

    def divided(self, frame: bytes) -> tuple[bytes, bytes]:
        """Both parts of the bytes of one frame in an export file."""
        return frame[: self._descriptor.itemsize], frame[self._descriptor.itemsize :]

    def descriptors(self, stored: Sequence[bytes]) -> NDArray[np.float32]:
        """Descriptors, float32 [n, D], from their stored form."""
        rows = np.frombuffer(b"".join(stored), self._descriptor)["stored"]
        return unpack_descriptors(rows, self.precision, self.dimension)

    def vectors(self, stored: Sequence[bytes]) -> Vectors:
        """Descriptors as they are held in memory: float16 [n, D] where they are stored so, else float32."""
        if self.precision != HALF:
            return self.descriptors(stored)
        return np.frombuffer(b"".join(stored), "<f2").reshape(len(stored), self.dimension)

    def inner_products(self, queries: NDArray[np.float32], stored: Sequence[bytes]) -> NDArray[np.float32]:
        """Inner products of queries, float32 [B, D], with descriptors in stored form: float32 [B, n]."""
        rows = np.frombuffer(b"".join(stored), self._descriptor)["stored"]
        return inner_products(queries, rows, self.precision)

    def locals(self, stored: Sequence[bytes]) -> NDArray[np.int8]:
        """Local descriptors, int8 [n, C, L], from their stored form."""
        if not self._local.itemsize:
            return np.empty((len(stored), *self.local_shape), np.int8)
        rows = np.frombuffer(b"".join(stored), self._local)["stored"]
        return unpack_local(rows, self.precision, self.local_shape)
