"""Candidates for a first stage: indexes of FAISS on the same descriptors, beside the one that maps have.

    python -m benchmarks.maps.first_stages [--places 20000] [--rounds 20] [--only NAME]

Each answers with its 100 best, in one thread; given are how often the exact best is among them, the median time of one
query and of each of eight together, taken in turns, the bytes of a place in memory, the milliseconds that adding one
takes, and the seconds of training.  All but the flat index get descriptors that are rotated at random, as RaBitQ wants
them; some are trained on descriptors that are not searched.  ``FAISS_SIMD_LEVEL=AVX2`` lets FAISS do without
AVX-512.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import faiss
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.maps.references import material
from benchmarks.report import report
from core.index import Coder, CodeTable
from core.index.table import CANDIDATES
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.threads import share_cores

Array = NDArray[np.float32]
Rows = NDArray[np.int64]

COUNT = 100
BLOCK = 2048
TOGETHER = 8
PAUSE = 0.05
SAMPLE_FROM = 2_000_000
"""Indexes learn from references from this row on, which are not among those searched."""
SAMPLE = 1500
INNER_PRODUCT = faiss.METRIC_INNER_PRODUCT


class FirstStage:
    """A FAISS index of rotated descriptors; ``size``: bytes of a place in memory."""

    def __init__(self, name: str, make: Callable[[int], Any], size: float, parameters: Any = None) -> None:
        self.name, self.size = name, size
        self._make, self._parameters = make, parameters
        self.train_seconds = self.add_seconds = 0.0

    def fill(self, sample: Array, blocks: Sequence[Array]) -> None:
        """Train, and add all places."""
        began = time.perf_counter()
        self._index = self._make(sample.shape[1])
        self._index.train(sample)
        trained = time.perf_counter()
        for block in blocks:
            self._index.add(block)
        self.train_seconds, self.add_seconds = trained - began, time.perf_counter() - trained

    def search(self, queries: Array) -> Rows:
        """The 100 best of each query, float32 [B, D]."""
        found: Rows = self._index.search(queries, COUNT, params=self._parameters)[1]
        return found


class Table:
    """The index of maps, its blocks joined."""

    name = "core.index"
    train_seconds = 0.0

    def fill(self, _sample: Array, blocks: Sequence[Array]) -> None:
        """Add all places."""
        began = time.perf_counter()
        table = CodeTable.empty(Coder.of(blocks[0].shape[1]))
        for block in blocks:
            table = table.appended(table.coder.encode(block))
        while (joined := table.joined()) is not None:
            table = table.with_block(joined)
        self._table, self.add_seconds = table, time.perf_counter() - began
        self.size = table.memory / len(table)

    def search(self, queries: Array) -> Rows:
        """The 100 best of each query, float32 [B, D]."""
        return np.array([found.rows for found in self._table.shortlists(queries, COUNT)])


def rabitq(dimension: int) -> Any:
    """Every code compared."""
    index = faiss.IndexRaBitQ(dimension, INNER_PRODUCT)
    index.qb = 4
    return index


def all_fast(dimension: int) -> Any:
    """Every code compared by the fast scan."""
    index = faiss.IndexRaBitQFastScan(dimension, INNER_PRODUCT)
    index.qb = 4
    return index


def lists(dimension: int) -> Any:
    """RaBitQ in 64 lists, of which six are looked into."""
    index = faiss.IndexIVFRaBitQ(faiss.IndexFlatIP(dimension), dimension, 64, INNER_PRODUCT)
    index.qb, index.nprobe = 4, 6
    return index


def graph(dimension: int) -> Any:
    """A graph over the codes, which FAISS has for Euclidean distances only."""
    index = faiss.IndexHNSWRaBitQ(dimension, 16)
    index.hnsw.efSearch = 2 * COUNT
    return index


def heads(values: int) -> Callable[[int], Any]:
    """The fast scan of the first values of the rotated descriptor, in one list, which takes selectors."""

    def make(dimension: int) -> Any:
        scan = faiss.IndexIVFRaBitQFastScan(faiss.IndexFlatIP(values), values, 1, INNER_PRODUCT)
        return faiss.IndexPreTransform(faiss.RemapDimensionsTransform(dimension, values, False), scan)

    return make


def principal(dimension: int) -> Any:
    """The fast scan of product codes of 512 principal values, in one list."""
    scan = faiss.IndexIVFPQFastScan(faiss.IndexFlatIP(512), 512, 1, 256, 4, INNER_PRODUCT)
    return faiss.IndexPreTransform(faiss.PCAMatrix(dimension, 512), scan)


def products(dimension: int) -> Any:
    """The fast scan of product codes of all values, in one list."""
    return faiss.IndexIVFPQFastScan(faiss.IndexFlatIP(dimension), dimension, 1, 256, 4, INNER_PRODUCT)


def refined(base: Callable[[int], Any], candidates: float) -> Callable[[int], Any]:
    """An index that compares the whole codes of ``candidates`` candidates for each row that it returns."""

    def make(dimension: int) -> Any:
        index = faiss.IndexRefine(base(dimension), rabitq(dimension))
        index.k_factor = candidates
        return index

    return make


def stages(dimension: int) -> list[FirstStage | Table]:
    """All that are compared, the exact search first."""
    code = dimension / 8 + 8
    return [
        FirstStage("IndexFlatIP, float32", faiss.IndexFlatIP, 4 * dimension),
        FirstStage("IndexRaBitQ", rabitq, code),
        FirstStage("IndexRaBitQFastScan", all_fast, code),
        FirstStage("IndexIVFRaBitQ, 6 of 64 lists", lists, code + 8),
        FirstStage("IndexHNSWRaBitQ, Euclidean", graph, code + 136),
        FirstStage("IndexIVFRaBitQFastScan, 2 048 values", heads(2048), 2048 / 8 + 16),
        FirstStage("IndexRefine(the same, RaBitQ), k_factor 8", refined(heads(2048), CANDIDATES), code + 2048 / 8 + 16),
        FirstStage("IndexRefine(… 1 024 values, RaBitQ), 20", refined(heads(1024), 20), code + 1024 / 8 + 16),
        FirstStage("IndexRefine(PCA 512, PQ 256×4, RaBitQ), 40", refined(principal, 40), code + 128 + 8),
        FirstStage("IndexRefine(PQ 256×4, RaBitQ), 20", refined(products, 20), code + 128 + 8),
        Table(),
    ]


def main(
    places: int = 20_000,
    rounds: int = 20,
    queries: Annotated[int, typer.Option(help="Of which the recall is taken.")] = 400,
    only: Annotated[list[str], typer.Option(help="Words of the names of what is measured beside the flat index.")] = [],  # noqa: B006
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    cache: Annotated[Path, typer.Option(help="Where encoded photographs are stored.")] = Path(".cache/references"),
) -> None:
    """Measure and report."""
    share_cores(1)
    of = material(datasets, EncoderCatalogue().get(DEFAULT_ENCODER), cache)
    plain, *others = stages(of.dimension)
    chosen = [stage for stage in others if not only or any(word in stage.name for word in only)]
    coder = Coder.of(of.dimension)
    queried = of.queries[np.unique(np.linspace(0, len(of.queries) - 1, queries).astype(int))]
    blocks = [block for _, block in of.blocks(places, BLOCK)]
    plain.fill(blocks[0], blocks)
    truth = plain.search(queried)[:, 0]
    flat = _timed([plain], {plain.name: queried}, rounds)[0]
    sample = coder.rotated(of.references(SAMPLE_FROM, SAMPLE_FROM + SAMPLE))
    turned = [coder.rotated(block) for block in blocks]
    questions: dict[str, Array] = {}
    for stage in chosen:
        is_table = isinstance(stage, Table)
        stage.fill(sample, blocks if is_table else turned)
        questions[stage.name] = queried if is_table else coder.rotated(queried)
        print(f"{stage.name}: filled in {stage.train_seconds + stage.add_seconds:.0f} s")
    times = [flat, *_timed(chosen, questions, rounds)]
    rows = []
    for stage, (alone, beside) in zip([plain, *chosen], times, strict=True):
        found = stage.search(questions.get(stage.name, queried))
        rows.append(
            {
                "name": stage.name,
                "milliseconds": alone,
                "together": beside,
                "faster": times[0][0] / alone,
                "recall": float(np.mean([row in best for row, best in zip(truth, found, strict=True)])),
                "bytes": stage.size,
                "add_milliseconds": 1e3 * stage.add_seconds / places,
                "train_seconds": stage.train_seconds,
            }
        )
    table = [
        [
            row["name"],
            row["milliseconds"],
            row["together"],
            f"{row['faster']:.1f}",
            f"{row['recall']:.4f}",
            f"{row['bytes']:.0f}",
            row["add_milliseconds"],
            f"{row['train_seconds']:.0f}",
        ]
        for row in rows
    ]
    columns = [
        "first stage",
        "ms",
        f"ms, of {TOGETHER}",
        "times faster",
        f"best in {COUNT}",
        "B",
        "add, ms",
        "train, s",
    ]
    level = faiss.SIMDConfig.get_level_name()
    figures = {"places": places, "rounds": rounds, "queries": len(queried), "level": level, "rows": rows}
    report("first-stages", f"one query against {places:,} places, {level}", columns, table, figures)


def _timed(chosen: Sequence[FirstStage | Table], questions: dict[str, Array], rounds: int) -> list[tuple[float, float]]:
    """Median milliseconds of one query, and of each of eight."""
    times: list[tuple[list[float], list[float]]] = [([], []) for _ in chosen]
    for turn in range(rounds + 1):
        for stage, of_stage in zip(chosen, times, strict=True):
            queried = np.roll(questions[stage.name], -7 * turn, axis=0)
            for some, stored in zip((1, TOGETHER), of_stage, strict=True):
                time.sleep(PAUSE)
                began = time.thread_time()
                stage.search(np.ascontiguousarray(queried[:some]))
                if turn:
                    stored.append(1e3 * (time.thread_time() - began) / some)
    return [(statistics.median(alone), statistics.median(beside)) for alone, beside in times]


if __name__ == "__main__":
    typer.run(main)
