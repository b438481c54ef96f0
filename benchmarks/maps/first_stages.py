"""What a first stage could be: FAISS's compact indexes beside the codes of ``core.index``, on the same descriptors.

    python -m benchmarks.maps.first_stages [--places 20000] [--rounds 20]

Each answers with its 100 best; how often the exact best is among them, and the median time, taken in turns.  FAISS's
indexes are given descriptors rotated as ours are, so that the comparison is one of codes and loops alone; PQ
is given the 512 principal values, which is what a code of 64 bytes can be about.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import faiss
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.maps.references import Material, material
from benchmarks.report import report
from core.index import CodedQuery, Coder, CodeTable
from core.index.best_estimates import best_first
from core.index.rotation import rotated
from core.kernels.codes import GROUP_BITS, estimates_of
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.threads import cores, share_cores

Array = NDArray[np.float32]

COUNT = 100
BLOCK = 2000
PAUSE = 0.05
SAMPLE_FROM = 2_000_000
"""Coders and FAISS's indexes learn from references from this row on, which are not among those searched."""


@dataclass(frozen=True)
class Stage:
    """``search`` gives the rows of its 100 best for a query, float32 [D]; ``size``: bytes of a place in memory."""

    name: str
    size: float
    search: Callable[[Array], NDArray[np.int64]]


def stages(of: Material, places: int) -> list[Stage]:
    """All that are compared, filled with the first references."""
    sample = of.references(SAMPLE_FROM, SAMPLE_FROM + 3000)
    coder = Coder.fitted(sample)
    table, plain, binary = CodeTable.empty(coder), faiss.IndexFlatIP(of.dimension), faiss.IndexBinaryFlat(of.dimension)
    rabitq = faiss.IndexRaBitQ(of.dimension, faiss.METRIC_INNER_PRODUCT)
    scanned = faiss.IndexRaBitQFastScan(of.dimension, faiss.METRIC_INNER_PRODUCT)
    product = faiss.IndexPQFastScan(GROUP_BITS, GROUP_BITS // 4, 4, faiss.METRIC_INNER_PRODUCT)
    rabitq.qb = scanned.qb = 4
    rabitq.train(rotated(sample, coder.signs))
    scanned.train(rotated(sample, coder.signs))
    product.train(coder.principal(sample))
    for _, block in of.blocks(places, BLOCK):
        codes, turned = coder.encode(block), rotated(block, coder.signs)
        table = table.appended(codes)
        plain.add(block)
        binary.add(codes.bits.view(np.uint8))
        product.add(coder.principal(block))
        rabitq.add(turned)
        scanned.add(turned)

    def turned_first(index: faiss.Index) -> Callable[[Array], NDArray[np.int64]]:
        return lambda query: _first(index, rotated(query[np.newaxis], coder.signs))

    return [
        Stage("FAISS IndexFlatIP, float32", 4 * of.dimension, lambda query: _first(plain, query[np.newaxis])),
        Stage("FAISS IndexBinaryFlat", of.dimension / 8, lambda query: _first(binary, _bits(coder, query))),
        Stage("FAISS IndexRaBitQ", of.dimension / 8 + 8, turned_first(rabitq)),
        Stage("FAISS IndexRaBitQFastScan", of.dimension / 8 + 8, turned_first(scanned)),
        Stage(
            "FAISS IndexPQFastScan, 512 values", 64, lambda query: _first(product, coder.principal(query[np.newaxis]))
        ),
        Stage(
            "core.index, every full code", of.dimension / 8 + 4, lambda query: _by_full_codes(table, coder.query(query))
        ),
        Stage("core.index", coder.bytes_per_place, lambda query: table.shortlist(coder.query(query), COUNT).rows),
    ]


def _first(index: faiss.Index | faiss.IndexBinary, query: NDArray[Any]) -> NDArray[np.int64]:
    rows: NDArray[np.int64] = index.search(query, COUNT)[1][0]
    return rows


def _bits(coder: Coder, query: Array) -> NDArray[np.uint8]:
    return coder.encode(query[np.newaxis]).bits.view(np.uint8)


def _by_full_codes(table: CodeTable, query: CodedQuery) -> NDArray[np.int64]:
    codes, made = table.codes(0, len(table)), np.empty(len(table), np.float32)
    estimates_of(codes.bits, codes.scales[:, 1], query.code.planes, query.code.step, query.code.total, made)
    return best_first(made, COUNT)


def main(
    places: int = 20_000,
    rounds: int = 20,
    queries: Annotated[int, typer.Option(help="Of which the recall is taken.")] = 400,
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    cache: Annotated[Path, typer.Option(help="Where encoded photographs are kept.")] = Path(".cache/references"),
) -> None:
    """Measure and report."""
    share_cores(cores())
    of = material(datasets, EncoderCatalogue().get(DEFAULT_ENCODER), cache)
    asked = of.queries[np.unique(np.linspace(0, len(of.queries) - 1, queries).astype(int))]
    made = stages(of, places)
    truth = [int(made[0].search(query)[0]) for query in asked]
    recalls = [
        statistics.fmean(row in stage.search(query) for query, row in zip(asked, truth, strict=True)) for stage in made
    ]
    times: list[list[float]] = [[] for _ in made]
    for turn in range(rounds + 1):
        for stage, its_times in zip(made, times, strict=True):
            time.sleep(PAUSE)
            began = time.perf_counter()
            stage.search(asked[turn % len(asked)])
            if turn:
                its_times.append(1e3 * (time.perf_counter() - began))
    medians = [statistics.median(its_times) for its_times in times]
    rows = [
        {
            "name": stage.name,
            "milliseconds": middle,
            "faster": medians[0] / middle,
            "recall": share,
            "bytes": stage.size,
        }
        for stage, middle, share in zip(made, medians, recalls, strict=True)
    ]
    table = [
        [row["name"], row["milliseconds"], f"{row['faster']:.1f}", f"{row['recall']:.4f}", f"{row['bytes']:.0f}"]
        for row in rows
    ]
    columns = ["first stage", "ms", "times faster", f"exact best in first {COUNT}", "B/place"]
    figures = {"places": places, "rounds": rounds, "queries": len(asked), "rows": rows}
    report("first-stages", f"one query against {places:,} places", columns, table, figures)


if __name__ == "__main__":
    typer.run(main)
