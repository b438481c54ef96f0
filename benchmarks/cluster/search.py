"""One query against many places: a data directory, PostgreSQL and Milvus, and Milvus's search alone, in turns.

    python -m benchmarks.cluster.search [--places 100000] [--milvus ADDRESS --postgres ADDRESS]

Places and queries are those of ``benchmarks.maps.search``.  The store asks Milvus and then PostgreSQL for the places
of the hits; *alone* is the first of these two.  The index of Milvus depends on its version (core.milvus.indexes);
that of scripts/cluster is flat.  Recall@1 is how often the first of a ranking is the one that exact float32 products
put first.  *Core ms* is processor time of a server for one search, which other load does not change.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.progress import Progress

from benchmarks.cluster.stores import MilvusAddress, PostgresAddress, Stores, both_stores, processor_seconds
from benchmarks.maps.references import Material, material
from benchmarks.maps.search import Array, Best, Contender, _enrolment, measure
from benchmarks.report import report, verdict
from core.errors import StoreUnavailable
from core.store import Map
from core.maps.records import Enrolment, MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.milvus.snapshot import SHORTLIST
from core.threads import cores, share_cores

LEAST_RECALL = 0.98
BLOCK, AT_ONCE = 2000, 256
IDLE_SECONDS, AGAIN_SECONDS, CLIENT_SECONDS = 5.0, 2.0, 600.0


def fill(stores: Stores, encoder: Encoder, of: Material, places: int) -> NDArray[np.int64]:
    """Enrol the references in a map of both stores; the row of the best for each query, int64 [q]."""
    maps = [
        store.create("search", encoder.identity, encoder.dimension, MapSettings(keep="none"))
        for store in (stores.embedded, stores.milvus)
    ]
    best = Best(np.full(len(of.queries), -np.inf, np.float32), np.zeros(len(of.queries), np.int64))
    queries = torch.from_numpy(of.queries)
    with Progress() as progress:
        task = progress.add_task(f"{places:,} places", total=places)
        for start, block in of.blocks(places, BLOCK):
            best = best.of(queries, block, start)
            enrolments = [_enrolment(start + offset, row) for offset, row in enumerate(block)]
            maps[0].enrol(enrolments)
            for first in range(0, len(block), AT_ONCE):
                enrol_as_a_client(maps[1], enrolments[first : first + AT_ONCE])
                progress.advance(task, len(enrolments[first : first + AT_ONCE]))
    return best.rows


def enrol_as_a_client(there: Map, enrolments: Sequence[Enrolment]) -> None:
    """Send again what is refused because a server is too busy; a batch is stored whole or not at all.

    Raises:
        StoreUnavailable: it was refused for ten minutes.
    """
    until = time.monotonic() + CLIENT_SECONDS
    while True:
        try:
            there.enrol(enrolments)
        except StoreUnavailable:
            if time.monotonic() > until:
                raise
            time.sleep(AGAIN_SECONDS)
        else:
            return


def run(stores: Stores, of: Material, truth: NDArray[np.int64], rounds: int) -> list[dict[str, Any]]:
    """The figures of every contender."""
    embedded, milvus = stores.embedded.get("search"), stores.milvus.get("search")
    embedded.edit({"index": "compact"})
    while (status := embedded.index_status()).state == "building" or status.tier != "compact":
        time.sleep(0.1)
    snapshot, scope = embedded.snapshot(), milvus.scope()
    state = scope.snapshot.state

    def alone(query: Array) -> NDArray[np.int64]:
        ((keys, _),) = milvus.collection.search(query[np.newaxis], f"map == {state.number}", SHORTLIST, state.recent)
        return keys

    queried: list[tuple[str, Callable[[Array], NDArray[np.int64]]]] = [
        ("embedded", lambda query: snapshot.search(query)[0]),
        (f"PostgreSQL and Milvus, {milvus.collection.index_type}", lambda query: scope.search(query[np.newaxis])[0][0]),
        (f"Milvus alone, {milvus.collection.index_type}", alone),
    ]
    contenders = [Contender(len(snapshot), name, search) for name, search in queried]
    found = []
    for contender, times in zip(contenders, measure(contenders, of.queries, rounds), strict=True):
        low, middle, high = statistics.quantiles(times, n=4)
        found.append({"store": contender.name, "milliseconds": middle, "quartiles": [low, high]})
    for row, (_, search) in zip(found[:2], queried, strict=False):
        first = np.array([int(search(query)[0]) for query in of.queries])
        row["recall"] = float(np.mean(first == truth))
    for part, process in stores.processes.items():
        found[1][f"{part}_milliseconds"] = processor_milliseconds(process, queried[1][1], of.queries)
    return found


def processor_milliseconds(process: int, search: Callable[[Array], object], queries: Array) -> float:
    """Processor time of a server for one search, without its time when idle."""
    before, began = processor_seconds(process), time.monotonic()
    time.sleep(IDLE_SECONDS)
    idle = (processor_seconds(process) - before) / (time.monotonic() - began)
    before, began = processor_seconds(process), time.monotonic()
    for query in queries:
        search(query)
    taken = processor_seconds(process) - before - idle * (time.monotonic() - began)
    return 1e3 * taken / len(queries)


def main(
    places: int = 100_000,
    rounds: int = 30,
    queries: Annotated[int, typer.Option(help="Spread evenly over all there are.")] = 200,
    milvus: MilvusAddress = "",
    postgres: PostgresAddress = "",
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    cache: Annotated[Path, typer.Option(help="Where encoded photographs are stored.")] = Path(".cache/references"),
) -> None:
    """Measure and report."""
    share_cores(cores())
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    of = material(datasets, encoder, cache)
    queried = np.unique(np.linspace(0, len(of.queries) - 1, min(queries, len(of.queries))).astype(int))
    of = replace(of, queries=of.queries[queried], walks=of.walks[queried])
    with both_stores(milvus, postgres) as stores:
        began = time.monotonic()
        truth = fill(stores, encoder, of, places)
        filled = time.monotonic() - began
        rows = run(stores, of, truth, rounds)
    parts = [f"{part}_milliseconds" for part in ("milvus", "postgres")]
    table = [
        [row["store"], row["milliseconds"], *(f"{row[name]:.4f}" if name in row else "" for name in ("recall", *parts))]
        for row in rows
    ]
    columns = ["store", "ms", "recall@1", "core ms of Milvus", "of PostgreSQL"]
    title = f"one query against {places:,} places; medians of {rounds} rounds"
    stored = {"places": places, "rows": rows, "fill_seconds": filled, "rounds": rounds, "queries": len(of.queries)}
    report("cluster_search", title, columns, table, stored)
    for row in rows[:2]:
        print(f"{row['store']:<40} {row['recall']:.4f}   {verdict(row['recall'], LEAST_RECALL, True)}")


if __name__ == "__main__":
    typer.run(main)
