"""The cost of storing descriptors in fewer bits: AUC-PR of both stages, by the stored form that a map searches.

    python -m benchmarks.maps.precision QUERIES REFERENCES TRUTH.csv [--encoder NAME] [--cache FILE.npz]

Queries are never stored and stay float32; references go through the storage's own packing and back.  ``first`` is
the first stage alone, ``both`` adds the second to every reference, ``changed`` says for how many queries another
reference is the best of the first stage, and of both, ``deviation`` by how much a first-stage score differs at most,
and ``error`` how long the differences of the descriptors are, by the length of the descriptors.  ``products`` is the
median time of the products of a query with 100 descriptors as they are stored, on one thread.

Beside them are FAISS's six bits a value, of a range that is fixed from the first row on, so that no row depends on a
later one: ±1; each value's range in the first 100 rows; ±1 of each row's largest value; ±1 of the largest of each 128,
as the storage does; for these FAISS has products only with rows that it has unpacked.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Literal, get_args

import faiss
import numpy as np
import torch
import typer
from numpy.typing import NDArray

from benchmarks.frames import encode_folder
from benchmarks.report import report
from core.frames.traverses import Truth, read_ground_truth
from core.judgement.curves import auc_pr
from core.maps.forms import (
    BLOCK,
    COMPRESSED,
    inner_products,
    pack_descriptors,
    pack_local,
    unpack_descriptors,
    unpack_local,
)
from core.maps.records import Precision
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.recognition.stages import score_matrix

Side = tuple[NDArray[np.float32], NDArray[np.int8]]
"""Descriptors float32 [n, D] and local descriptors int8 [n, C, L]."""
Array = NDArray[np.float32]
Products = Callable[[Array], Array]
"""The products of queries, float32 [B, D], with stored rows: float32 [B, n]."""

MOST_TIMED, REPEATS = 100, 60


def encoded(encoder: Encoder, folder: Path) -> Side:
    """All frames of a folder."""
    encodings = encode_folder(encoder, folder)
    return np.stack([one.descriptor for one in encodings]), np.stack([one.local for one in encodings])


def sides(encoder: Encoder, queries: Path, references: Path, cache: Path | None) -> tuple[Side, Side]:
    """Queries and references, from ``cache`` if it is there."""
    if cache is not None and cache.is_file():
        with np.load(cache) as stored:
            return (stored["qd"], stored["ql"]), (stored["rd"], stored["rl"])
    queried, known = encoded(encoder, queries), encoded(encoder, references)
    if cache is not None:
        np.savez(cache, qd=queried[0], ql=queried[1], rd=known[0], rl=known[1])
    return queried, known


def at_rest(side: Side, precision: Precision | Literal["float32"]) -> tuple[Side, int]:
    """A side as it is read back from its stored form, or itself for float32, and bytes a place."""
    descriptors, local = side
    if precision == "float32":
        return side, descriptors[0].nbytes + local[0].nbytes
    stored, stored_local = pack_descriptors(descriptors, precision), pack_local(local, precision)
    back = (
        unpack_descriptors(stored, precision, descriptors.shape[1]),
        unpack_local(stored_local, precision, local.shape[1:]),
    )
    return back, stored[0].nbytes + stored_local[0].nbytes


def faiss_index(low: Array, high: Array) -> faiss.IndexScalarQuantizer:
    """An index of six bits a value with the given ranges, float32 [D]."""
    index = faiss.IndexScalarQuantizer(len(low), faiss.ScalarQuantizer.QT_6bit, faiss.METRIC_INNER_PRODUCT)
    faiss.copy_array_to_vector(np.concatenate([low, high - low]), index.sq.trained)
    index.is_trained = True
    return index


def by_faiss(rows: Array, low: Array, high: Array, scales: Array) -> tuple[Array, int, Products]:
    """Rows as they come back, float32 [n, D], bytes a row, and products with the first rows in their codes.

    Args:
        scales: float32 [n, D / d], by which d values each are divided before; low, high: float32 [d].
    """
    index, values = faiss_index(low, high), len(low)
    parts = rows.reshape(-1, values) / scales.reshape(-1, 1)
    codes = index.sa_encode(parts)
    back = (index.sa_decode(codes) * scales.reshape(-1, 1)).reshape(rows.shape)
    timed = codes[: MOST_TIMED * scales.shape[1]]
    factors = scales[:MOST_TIMED].reshape(-1, 1)

    def products(queries: Array) -> Array:
        if scales.shape[1] > 1:
            return queries @ (index.sa_decode(timed) * factors).reshape(-1, rows.shape[1]).T
        index.reset()
        index.add_sa_codes(timed)
        found, where = index.search(queries, len(timed))
        made = np.empty_like(found)
        np.put_along_axis(made, where, found, axis=1)
        return made * factors.T

    scaled = bool((scales != 1).any())  # in half precision, as the storage has its own
    return back, scales.shape[1] * (codes.shape[1] + 2 * scaled), products


def variants_of_faiss(rows: Array) -> dict[str, tuple[Array, int, Products]]:
    """FAISS's six bits of rows, by the range of values."""
    n, dimension = rows.shape
    ones, single, first = np.ones(dimension, np.float32), np.ones((n, 1), np.float32), rows[:100]
    largest = np.abs(rows).max(axis=1, keepdims=True)
    found = {
        "FAISS, ±1": by_faiss(rows, -ones, ones, single),
        "FAISS, first 100 rows": by_faiss(rows, first.min(axis=0), first.max(axis=0), single),
        "FAISS, a scale a row": by_faiss(rows, -ones, ones, largest),
    }
    if dimension % BLOCK == 0:
        blocks = np.maximum(np.abs(rows).reshape(n, -1, BLOCK).max(axis=2), np.float32(1e-9))
        found["FAISS, a scale a block"] = by_faiss(rows, -ones[:BLOCK], ones[:BLOCK], blocks)
    return found


def milliseconds(products: Products, queries: Array) -> float:
    """The median time of one query's products, of some queries one after the other."""
    taken = []
    for number in range(REPEATS):
        began = time.perf_counter()
        products(queries[number % len(queries)][np.newaxis])
        taken.append(1000 * (time.perf_counter() - began))
    return median(taken)


def main(
    queries: Path,
    references: Path,
    truth_file: Annotated[Path, typer.Argument(metavar="TRUTH.csv")],
    encoder: str = DEFAULT_ENCODER,
    cache: Annotated[Path | None, typer.Option(help="Where encoded frames are stored, .npz.")] = None,
) -> None:
    """Measure, print a table and write JSON."""
    chosen = EncoderCatalogue().get(encoder)
    queried, known = sides(chosen, queries, references, cache)
    truth = read_ground_truth(truth_file, len(queried[0]), len(known[0]))
    faiss.omp_set_num_threads(1)
    torch.set_num_threads(1)
    ways: dict[str, tuple[Side, int, Products]] = {}
    for precision in ("float32", *get_args(Precision)):
        back, size = at_rest(known, precision)
        some = known[0][:MOST_TIMED] if precision == "float32" else pack_descriptors(known[0][:MOST_TIMED], precision)
        ways[precision] = back, size, partial(_products, some, precision)
    cells = at_rest(known, COMPRESSED)[0][1]
    for name, (back_by_faiss, size, products) in variants_of_faiss(known[0]).items():
        ways[name] = (back_by_faiss, cells), size + pack_local(known[1][:1], COMPRESSED).nbytes, products

    figures: dict[str, dict[str, float]] = {}
    exact: list[NDArray[Any]] = []
    for name, (back, size, products) in ways.items():
        scores = queried[0] @ back[0].T
        first, both = chosen.scores_from_inner_products(scores), score_matrix(chosen, scores, queried[1], back[1])
        if not figures:
            exact = [first, first.argmax(axis=1), both.argmax(axis=1)]
        figures[name] = {
            "bytes": size,
            "first": area(first, truth),
            "both": area(both, truth),
            "changed_first": int((first.argmax(axis=1) != exact[1]).sum()),
            "changed_both": int((both.argmax(axis=1) != exact[2]).sum()),
            "deviation": float(np.abs(first - exact[0]).max()),
            "error": float(np.linalg.norm(back[0] - known[0]) / np.linalg.norm(known[0])),
            "products_ms": milliseconds(products, queried[0]),
        }
    rows = [
        (
            name,
            one["bytes"],
            *(f"{one[column]:.4f}" for column in ("first", "both")),
            f"{one['changed_first']}, {one['changed_both']}",
            *(f"{one[column]:.4f}" for column in ("deviation", "error", "products_ms")),
        )
        for name, one in figures.items()
    ]
    columns = ["precision", "bytes", "first, AUC-PR", "both, AUC-PR", "changed", "deviation", "error", "products, ms"]
    more = {"encoder": chosen.identity, "precisions": figures}
    report("precision", f"{len(queried[0])} queries, {len(known[0])} references", columns, rows, more)


def _products(stored: NDArray[Any], precision: str, queries: Array) -> Array:
    if precision == "float32":
        return np.asarray(queries @ stored.T)
    return inner_products(queries, stored, COMPRESSED if precision == COMPRESSED else "half")


def area(scores: NDArray[np.float32], truth: Truth) -> float:
    """AUC-PR of the best matches; scores [Q, R]."""
    right = [bool(np.isin(place, true)) for place, true in zip(scores.argmax(axis=1), truth, strict=True)]
    return auc_pr(scores.max(axis=1), right)


if __name__ == "__main__":
    typer.run(main)
