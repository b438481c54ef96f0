"""How descriptors are kept on disk, and how they come back.

full        float32 and int8, as they are: maps of the first two versions of segment files
half        descriptors in half precision, local descriptors as they are
compressed  descriptors in six bits a value and a scale a block of 128 values, local descriptors in four bits a
            value and a step a cell: 29 KB instead of 98 for the default encoder

Intra-normalised VLADs and unit vectors have values within [-1, 1], most of them near 1 / 128 (D = 16 384), which half
precision keeps to 11 bits.  What is searched, shown and compared is what is stored, brought back to float32 and int8.
``python -m benchmarks.precision`` measures what each costs.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from core.index.exact import compare
from core.kernels.packed import packed_products

Descriptor = NDArray[np.float32]
Local = NDArray[np.int8]
"""Local descriptors of one frame, [C, L]; [0, 0] where the encoder has no second stage."""

Precision = Literal["full", "half", "compressed"]
NewPrecision = Literal["half", "compressed"]
"""Those that a map can be made with."""

FULL: Precision = "full"
HALF: Precision = "half"
COMPRESSED: Precision = "compressed"

LARGEST_HALF = 65504.0
"""What half precision can say."""

BLOCK = 128
"""Values of a compressed descriptor that share a scale: the part of one word of the default encoder."""

_HIGHEST = 31  # six bits say -31 to 31, kept as 1 to 63: the upper four bits of two a byte, the lower two of four
_HIGHEST_LOCAL = 7  # four bits say -7 to 7, kept as 1 to 15, two a byte

_BYTES = np.arange(256)
_HALVES = np.stack([_BYTES % 16, _BYTES // 16], axis=1)
_QUARTERS = np.stack([_BYTES >> shift & 3 for shift in (0, 2, 4, 6)], axis=1)
_UPPER = (4 * _HALVES - 32).astype(np.float32)
_LOWER = _QUARTERS.astype(np.float32)
_LOCAL = (_HALVES - 8).astype(np.int8)

_FEW_QUERIES = 4  # for more it is quicker to unpack once

Field = tuple[str, tuple[int, ...]]
"""Type and shape of a field of a record."""


def resting_types(precision: Precision, dimension: int, local_shape: tuple[int, int]) -> tuple[Field, Field]:
    """How a descriptor of D values and local descriptors of shape (C, L) are kept."""
    if precision == COMPRESSED:
        cells, values = local_shape
        blocks = -(-dimension // BLOCK)
        return ("u1", (blocks * (2 + BLOCK // 2 + BLOCK // 4),)), ("u1", (cells * (1 + -(-values // 2)),))
    return ("<f4" if precision == FULL else "<f2", (dimension,)), ("i1", local_shape)


def pack_descriptors(descriptors: NDArray[np.float32], precision: Precision) -> NDArray[Any]:
    """float32 [n, D] as it is kept, [n, …]; halves are rounded to the nearest, ties to even."""
    if precision == FULL:
        return descriptors
    if precision == HALF:
        return descriptors.astype("<f2")
    n, dimension = descriptors.shape
    count = -(-dimension // BLOCK)
    blocks = _whole_blocks(descriptors).reshape(n, count, BLOCK)
    # Upwards, so that no value lies outside; a block of zeros has any scale.
    scales = np.nextafter((np.abs(blocks).max(axis=2) / _HIGHEST).astype("<f2"), np.float16(np.inf)).astype("<f2")
    values = np.rint(blocks / scales[:, :, np.newaxis].astype(np.float32)).reshape(n, count * BLOCK)
    codes = (np.clip(values, -_HIGHEST, _HIGHEST) + 32).astype(np.uint8)
    lower = codes & 3
    quarters = lower[:, ::4] | lower[:, 1::4] << 2 | lower[:, 2::4] << 4 | lower[:, 3::4] << 6
    return np.concatenate([scales.view(np.uint8), _paired(codes >> 2), quarters], axis=1)


def _whole_blocks(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """float32 [n, D] with zeros up to the next whole block; the vectors themselves where none are missing."""
    missing = -vectors.shape[1] % BLOCK
    return np.pad(vectors, ((0, 0), (0, missing))) if missing else vectors


def _paired(codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Numbers under 16, an even number of them in the last axis, two a byte."""
    return np.asarray(codes[..., ::2] | codes[..., 1::2] << 4)


def unpack_descriptors(kept: NDArray[Any], precision: Precision, dimension: int) -> NDArray[np.float32]:
    """float32 [n, D] of what :func:`pack_descriptors` gave."""
    if precision != COMPRESSED:
        return np.ascontiguousarray(kept, dtype=np.float32)
    n, count = len(kept), -(-dimension // BLOCK)
    scales, pairs, quarters = _parts_of(kept, dimension)
    values = _UPPER[pairs].reshape(n, count * BLOCK)
    values += _LOWER[quarters].reshape(n, count * BLOCK)
    blocks = values.reshape(n, count, BLOCK)
    blocks *= scales[:, :, np.newaxis]
    return np.ascontiguousarray(values[:, :dimension])


def _parts_of(kept: NDArray[Any], dimension: int) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8]]:
    """Scales float32 [n, blocks], upper four bits of values two a byte, lower two bits four a byte."""
    count = -(-dimension // BLOCK)
    scales = np.ascontiguousarray(kept[:, : 2 * count]).view("<f2").astype(np.float32)
    return scales, kept[:, 2 * count : (2 + BLOCK // 2) * count], kept[:, (2 + BLOCK // 2) * count :]


def pack_local(local: Local, precision: Precision) -> NDArray[Any]:
    """int8 [n, C, L] as it is kept, [n, …].  Compressed: in whole steps, of each cell as small as its values allow."""
    if precision != COMPRESSED:
        return local
    n = len(local)
    if not local.size:
        return np.empty((n, 0), np.uint8)
    real = np.pad(local.astype(np.float32), ((0, 0), (0, 0), (0, local.shape[2] % 2)))
    steps = np.maximum(1, np.ceil(np.abs(real).max(axis=2) / _HIGHEST_LOCAL)).astype(np.uint8)
    pairs = _paired((np.rint(real / steps[:, :, np.newaxis]) + 8).astype(np.uint8))
    return np.concatenate([steps, pairs.reshape(n, -1)], axis=1)


def unpack_local(kept: NDArray[Any], precision: Precision, local_shape: tuple[int, int]) -> Local:
    """int8 [n, C, L] of what :func:`pack_local` gave."""
    if precision != COMPRESSED:
        return np.ascontiguousarray(kept)
    n, (cells, values) = len(kept), local_shape
    if not cells:
        return np.empty((n, *local_shape), np.int8)
    steps, pairs = kept[:, :cells].astype(np.int16), kept[:, cells:]
    real = _LOCAL[pairs].reshape(n, cells, 2 * -(-values // 2))[:, :, :values] * steps[:, :, np.newaxis]
    return np.clip(real, -127, 127).astype(np.int8)


def inner_products(queries: NDArray[np.float32], kept: NDArray[Any], precision: Precision) -> NDArray[np.float32]:
    """Of queries, float32 [B, D], with kept descriptors, [k, …]: float32 [B, k].

    Halves are brought back to float32 register by register; every product is summed in float32.
    """
    rows, dimension = len(kept), queries.shape[1]
    if precision == COMPRESSED:
        if len(queries) > _FEW_QUERIES:
            return np.asarray(queries @ unpack_descriptors(kept, precision, dimension).T)
        scales, uppers, lowers = _parts_of(kept, dimension)
        made = [packed_products(query, scales, uppers, lowers) for query in _whole_blocks(queries)]
        return np.array(made, np.float32).reshape(len(queries), rows)
    return compare(queries, kept, np.arange(rows))
