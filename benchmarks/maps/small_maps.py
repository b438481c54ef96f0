"""What the search of a small map costs, every place compared: FAISS's indexes beside ``core.index.exact``.

    python -m benchmarks.maps.small_maps [--places 1622] [--rounds 25]

One thread, of which wall time and processor time are the same; taken in turns, medians.  Descriptors are random, for
what is in them costs no time.  *Search* is all that a map does with queries that come together, products and rankings,
on one thread for every two cores.
"""

from __future__ import annotations

from collections.abc import Callable

import faiss
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.report import report
from core.evaluation.timing import medians
from core.index.exact import compare
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.places import NO_POSE
from core.storage.files.segment_files import ROWS_PER_SEGMENT
from core.storage.search.segment import Location
from core.storage.search.snapshot import Snapshot
from core.threads import share_cores

Array = NDArray[np.float32]
TOGETHER = (1, 2, 4, 8, 16)


def runs(kept: Array, queries: Array) -> dict[str, Callable[[], object]]:
    """All that are compared: ``kept``, float32 [n, D], of values that half precision says, with ``queries`` [B, D]."""
    places, dimension = kept.shape
    flat = faiss.IndexFlatIP(dimension)
    halved = faiss.IndexScalarQuantizer(dimension, faiss.ScalarQuantizer.QT_fp16, faiss.METRIC_INNER_PRODUCT)
    halved.is_trained = True
    for index in (flat, halved):
        index.add(kept)
    halves, every = kept.astype(np.float16), np.arange(places)
    empty = Snapshot(dimension, ROWS_PER_SEGMENT, halves=True)
    snapshot = empty.appended(list(kept), [Location(NO_POSE, (0.0, 0.0, 0.0), -1, 0)] * places)
    return {
        "FAISS, float32": lambda: flat.search(queries, places),
        "FAISS, half": lambda: halved.search(queries, places),
        "core.index.exact, float32": lambda: compare(queries, kept, every),
        "core.index.exact, half": lambda: compare(queries, halves, every),
        "search": lambda: snapshot.search_batch(queries),
    }


def main(places: int = 1622, rounds: int = 25) -> None:
    """Measure and report."""
    share_cores(1)
    random = np.random.default_rng(0)
    dimension = EncoderCatalogue().get(DEFAULT_ENCODER).dimension
    kept = random.standard_normal((places, dimension), np.float32).astype(np.float16).astype(np.float32)
    queries = random.standard_normal((max(TOGETHER), dimension), np.float32)
    found = {count: medians(runs(kept, queries[:count]), rounds) for count in TOGETHER}
    table = [[name, *(found[count][name] for count in TOGETHER)] for name in found[1]]
    columns = ["milliseconds for", *(f"{count} together" for count in TOGETHER)]
    figures = {"places": places, "rounds": rounds, "milliseconds": found}
    report("small-maps", f"queries against {places:,} places", columns, table, figures)


if __name__ == "__main__":
    typer.run(main)
