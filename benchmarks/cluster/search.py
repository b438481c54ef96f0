"""The first stage of one query against many places: codes in memory, and a Milvus, in turns.

    python -m benchmarks.cluster.search [--places 20000] [--milvus ADDRESS]

Places and queries are those of ``benchmarks.maps.search``.  The index of Milvus depends on its version
(``core.index.milvus``); that of scripts/cluster compares every place.  Recall is how often the shortlist has the place
that exact float32 products put first.  *Core ms* is processor time of Milvus for one search, which other load does not
change.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import Progress

from benchmarks.maps.references import Material, material
from benchmarks.report import report, verdict
from core.index import Coder, CodeTable, FirstStage
from core.index.milvus import RECENT_SECONDS, Milvus, MilvusCodes
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.store.snapshot import SHORTLIST, threads
from core.threads import cores, share_cores
from tests.servers.milvus import running_milvus

LEAST_RECALL = 0.98
BLOCK, AT_ONCE = 2000, 256
IDLE_SECONDS = 5.0
UID = "benchmark_search"

Array = NDArray[np.float32]


def processor_seconds(process: int) -> float:
    """That a process and its children have taken since they were started; Linux."""
    found = 0
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (folder / "stat").read_text().rpartition(")")[2].split()
            if process in (int(folder.name), int(words[1])):
                found += int(words[11]) + int(words[12])
    return found / os.sysconf("SC_CLK_TCK")


def filled(milvus: Milvus, of: Material, places: int) -> tuple[CodeTable, MilvusCodes, NDArray[np.int64]]:
    """The references in both, and the row of the best for each query, int64 [q]."""
    coder = Coder.of(of.dimension)
    table, there = CodeTable.empty(coder), milvus.codes(UID, of.dimension, places)
    products, rows = np.full(len(of.queries), -np.inf, np.float32), np.zeros(len(of.queries), np.int64)
    with Progress() as progress:
        task = progress.add_task(f"{places:,} places", total=places)
        for start, block in of.blocks(places, BLOCK):
            found = of.queries @ block.T
            better = found.max(axis=1) > products
            rows = np.where(better, start + found.argmax(axis=1), rows)
            products = np.maximum(products, found.max(axis=1))
            table = table.appended(coder.encode(block))
            there = there.brought_up(enumerate(block, start), start + len(block))
            progress.advance(task, len(block))
    while (joined := table.joined()) is not None:
        table = table.with_block(joined)
    return table, there, rows


def measured(
    stages: dict[str, FirstStage], of: Material, truth: NDArray[np.int64], rounds: int
) -> list[dict[str, Any]]:
    """The figures of each, which take turns."""
    executor, _ = threads()
    times: dict[str, list[float]] = {name: [] for name in stages}
    for number in range(rounds):
        for name, stage in stages.items():
            query, began = of.queries[number % len(of.queries), np.newaxis], time.perf_counter()
            stage.shortlists(query, SHORTLIST, None, executor)
            times[name].append(1e3 * (time.perf_counter() - began))
    rows = []
    for name, stage in stages.items():
        low, middle, high = statistics.quantiles(times[name], n=4)
        shortlists = stage.shortlists(of.queries, SHORTLIST, None, executor)
        recall = float(np.mean([best in one.rows for best, one in zip(truth, shortlists, strict=True)]))
        rows.append({"stage": name, "milliseconds": middle, "quartiles": [low, high], "recall": recall})
    return rows


def processor_milliseconds(process: int, search: Callable[[Array], object], queries: Array) -> float:
    """Processor time of a server for one search, without its time when idle."""
    before, began = processor_seconds(process), time.monotonic()
    time.sleep(IDLE_SECONDS)
    idle = (processor_seconds(process) - before) / (time.monotonic() - began)
    before, began = processor_seconds(process), time.monotonic()
    for query in queries:
        search(query[np.newaxis])
    taken = processor_seconds(process) - before - idle * (time.monotonic() - began)
    return 1e3 * taken / len(queries)


def main(
    places: int = 20_000,
    rounds: int = 30,
    queries: Annotated[int, typer.Option(help="Spread evenly over all there are.")] = 200,
    milvus: Annotated[str, typer.Option(help="Of a Milvus; empty: one of this machine's own.")] = "",
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    cache: Annotated[Path, typer.Option(help="Where encoded photographs are stored.")] = Path(".cache/references"),
) -> None:
    """Measure and report."""
    share_cores(cores())
    of = material(datasets, EncoderCatalogue().get(DEFAULT_ENCODER), cache)
    chosen = np.unique(np.linspace(0, len(of.queries) - 1, min(queries, len(of.queries))).astype(int))
    of = replace(of, queries=of.queries[chosen], walks=of.walks[chosen])
    with ExitStack() as stack:
        server = None if milvus else stack.enter_context(running_milvus())
        connected = Milvus(milvus or (server.address if server else ""))
        stack.callback(connected.close)
        stack.callback(connected.drop, lambda uid: uid == UID)
        began = time.monotonic()
        table, there, truth = filled(connected, of, places)
        filling = time.monotonic() - began
        time.sleep(RECENT_SECONDS)  # then a search waits for nothing
        index = there.made.kind if there.made else ""
        rows = measured({"codes in memory": table, f"Milvus, {index}": there}, of, truth, rounds)
        if server is not None:
            search = lambda query: there.shortlists(query, SHORTLIST)  # noqa: E731
            rows[1]["core_milliseconds"] = processor_milliseconds(server.process.process_id, search, of.queries)
    columns = ["first stage", "ms", "recall", "core ms of Milvus"]
    shown = [
        [row["stage"], row["milliseconds"], f"{row['recall']:.4f}", f"{row.get('core_milliseconds', 0):.1f}"]
        for row in rows
    ]
    title = f"the first stage of one query against {places:,} places; medians of {rounds} rounds"
    stored = {"places": places, "rows": rows, "fill_seconds": filling, "rounds": rounds, "queries": len(of.queries)}
    report("cluster_search", title, columns, shown, stored)
    for row in rows:
        print(f"{row['stage']:<24} {row['recall']:.4f}   {verdict(row['recall'], LEAST_RECALL, True)}")


if __name__ == "__main__":
    typer.run(main)
