"""Exact inner products with descriptors in memory, by FAISS's flat indexes; and rankings."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import faiss
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Positions = NDArray[np.int64]
Flags = NDArray[np.bool_]
Vectors = NDArray[np.float16] | NDArray[np.float32]


@contextmanager
def in_one_thread() -> Iterator[None]:
    """Let FAISS compute in the calling thread alone: a search distributes its work among threads itself."""
    before = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    try:
        yield
    finally:
        faiss.omp_set_num_threads(before)


def flat_index(capacity: int, dimension: int, halves: bool = False) -> faiss.IndexFlatCodes:
    """An inner-product index with room for ``capacity`` rows of zeros, to be filled through :func:`vectors`.

    Args:
        halves: hold the rows in half precision; their values have to be exact in it.
    """
    index: faiss.IndexFlatCodes = faiss.IndexFlatIP(dimension)
    if halves:
        index = faiss.IndexScalarQuantizer(dimension, faiss.ScalarQuantizer.QT_fp16, faiss.METRIC_INNER_PRODUCT)
        index.is_trained = True  # this kind of index needs no training
    index.codes.resize(capacity * index.code_size)
    index.ntotal = capacity
    return index


def stored(index: faiss.IndexFlatCodes) -> NDArray[np.uint8]:
    """The rows of an index as FAISS stores them, without a copy: uint8 [capacity, bytes], valid while it lives."""
    size = index.ntotal * index.code_size
    flat: NDArray[np.uint8] = faiss.rev_swig_ptr(index.codes.data(), size) if size else np.empty(0, np.uint8)
    return flat.reshape(index.ntotal, index.code_size)


def vectors(index: faiss.IndexFlatCodes) -> Vectors:
    """The rows of an index without a copy: float32 or float16 [capacity, D], valid as long as the index lives."""
    rows = stored(index).reshape(-1)
    found: Vectors = rows.view(np.float16) if index.code_size == 2 * index.d else rows.view(np.float32)
    return found.reshape(index.ntotal, index.d)


def selector(chosen: Flags) -> faiss.IDSelector:
    """The selector that limits a search to the chosen rows; bool [capacity]."""
    return faiss.IDSelectorBitmap(np.packbits(chosen, bitorder="little"))


def products(index: faiss.IndexFlatCodes, queries: Array, chosen: Positions | None = None) -> Array:
    """Inner products of queries with rows of a flat index.

    Args:
        queries: float32 [B, D], contiguous.
        chosen: int64 [k], ascending; None: all rows.

    Returns:
        float32 [B, k], summed in float32.
    """
    chosen = np.arange(index.ntotal) if chosen is None else chosen
    made = np.empty((len(queries), len(chosen)), np.float32)
    if not made.size:
        return made
    parameters = None
    if len(chosen) < index.ntotal:
        flags = np.zeros(index.ntotal, np.bool_)
        flags[chosen] = True
        parameters = faiss.SearchParameters(sel=selector(flags))
    with in_one_thread():
        found, rows = index.search(queries, len(chosen), params=parameters)
    np.put_along_axis(made, np.searchsorted(chosen, rows), found, axis=1)
    return made


def ranked(rows: Positions, found: Array) -> tuple[Positions, Array]:
    """Rows, int64 [n], and their products, float32 [n], in the order of the products, best first; equal ones by row."""
    order = np.lexsort((rows, -found))
    return rows[order], found[order]
