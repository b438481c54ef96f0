"""The cost of a search of a small map: every place compared by FAISS's flat indexes, and codes first, as maps do.

    python -m benchmarks.maps.small_maps [--places 2000] [--rounds 25]

One thread, by its processor time; taken in turns, medians.  Descriptors are random, for what is in them
costs no time.  *Exact* and *compact* are all that a map in memory does with queries that come together, rankings
included, in either tier.  ``FAISS_SIMD_LEVEL=AVX2`` lets FAISS do without AVX-512.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import faiss
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.report import report
from core.index import Coder, CodeTable
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.places import NO_POSE
from core.store.following import ROWS_PER_SEGMENT
from core.store.segment import Location
from core.store.snapshot import Snapshot
from core.threads import share_cores

Array = NDArray[np.float32]
TOGETHER = (1, 2, 4, 8, 16)


def runs(retained: Array, of_map: Snapshot, queries: Array) -> dict[str, Callable[[], object]]:
    """All that are compared: ``retained``, float32 [n, D], of half-precision values, with ``queries`` [B, D]."""
    places, dimension = retained.shape
    flat = faiss.IndexFlatIP(dimension)
    halved = faiss.IndexScalarQuantizer(dimension, faiss.ScalarQuantizer.QT_fp16, faiss.METRIC_INNER_PRODUCT)
    halved.is_trained = True
    for index in (flat, halved):
        index.add(retained)
    exact = replace(of_map, table=None)
    return {
        "IndexFlatIP, float32": lambda: flat.search(queries, places),
        "IndexScalarQuantizer, half": lambda: halved.search(queries, places),
        "exact": lambda: exact.search_batch(queries),
        "compact": lambda: of_map.search_batch(queries),
    }


def processor_medians(chosen: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median milliseconds of processor time by name, taken in turns; the first round is not counted."""
    times: dict[str, list[float]] = {name: [] for name in chosen}
    for turn in range(rounds + 1):
        for name, run in chosen.items():
            began = time.thread_time()
            run()
            if turn:
                times[name].append(1e3 * (time.thread_time() - began))
    return {name: statistics.median(found) for name, found in times.items()}


def main(places: int = 2000, rounds: int = 25) -> None:
    """Measure and report."""
    share_cores(1)
    random = np.random.default_rng(0)
    dimension = EncoderCatalogue().get(DEFAULT_ENCODER).dimension
    retained = random.standard_normal((places, dimension), np.float32).astype(np.float16).astype(np.float32)
    queries = random.standard_normal((max(TOGETHER), dimension), np.float32)
    snapshot = Snapshot(dimension, ROWS_PER_SEGMENT, table=CodeTable.empty(Coder.of(dimension)), halves=True)
    snapshot = snapshot.appended(list(retained), [Location(NO_POSE, (0.0, 0.0, 0.0), -1, 0)] * places)
    found = {count: processor_medians(runs(retained, snapshot, queries[:count]), rounds) for count in TOGETHER}
    table = [[name, *(found[count][name] for count in TOGETHER)] for name in found[1]]
    columns = ["milliseconds for", *(f"{count} together" for count in TOGETHER)]
    level = faiss.SIMDConfig.get_level_name()
    figures = {"places": places, "rounds": rounds, "level": level, "milliseconds": found}
    report("small-maps", f"queries against {places:,} places, {level}", columns, table, figures)


if __name__ == "__main__":
    typer.run(main)
