"""How long one query takes against a map, and what it finds, by the number of places.

    python -m benchmarks.maps.search [--places 1000 --places 10000] [--rounds 30] [--queries 1040] [--keep FOLDER]
    python -m benchmarks.maps.search --million --keep FOLDER    # up to 1M places: a long run, 20 GB of disk

Maps are written through the store (``core.store``), of real places and distractors synthesized from real
descriptors (:mod:`benchmarks.maps.references`), and searched as the service searches them: the first stage, and the
exact comparison of the shortlist with what the disk holds; the encoder's second stage is not in it.  Flat is FAISS's
IndexFlatIP over float32; over more than 20 000 places its time is that of 20 000, scaled linearly.  All are measured
in turns, so that whatever else the machine does falls on all of them alike; medians are shown.

The truth is the best of all references by float32 inner products, computed while they are written; recall@1 is how
often just that row comes first.  ``python -m benchmarks.maps.search_plots`` draws the figures.
"""

from __future__ import annotations

import hashlib
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import faiss
import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.progress import Progress

from benchmarks.maps.references import Material, material
from benchmarks.report import report, verdict
from core.errors import UnknownMap
from core.maps import Enrolment, MapSettings, Precision
from core.maps.forms import Form
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.places import PlaceFields
from core.store import Directory, Map
from core.store.snapshot import Snapshot
from core.threads import cores, share_cores

Array = NDArray[np.float32]

FLAT_PLACES = 20_000
MILLION = 1_000_000
PAUSE = 0.05
"""Seconds between two measurements: the threads of a BLAS go on spinning for a while after their work."""
BLOCK = 2000


@dataclass(frozen=True)
class Bar:
    """Times faster than flat and recall@1, at least; bytes of a place in memory and on disk, at most."""

    faster: float
    recall: float
    memory: float
    disk: float


BARS = {
    (100_000, "half"): Bar(50.0, 0.995, 8192, 98_000),
    (MILLION, "compressed"): Bar(150.0, 0.98, 8192, 32_768),
}
GROWTH = 4.0
"""A query against a million places is to take at most this many times as long as one against a hundred thousand."""


@dataclass(frozen=True)
class Best:
    """The best of the references seen so far, of each query: inner products float32 [q] and rows int64 [q]."""

    products: Array
    rows: NDArray[np.int64]

    def of(self, queries: torch.Tensor, block: Array, first: int) -> Best:
        """With the references ``first`` and on seen too."""
        products, offsets = (found.numpy() for found in (queries @ torch.from_numpy(block).T).max(dim=1))
        better = products > self.products
        return Best(np.where(better, products, self.products), np.where(better, offsets + first, self.rows))


def write_map(folder: Path, encoder: Encoder, of: Material, places: int, precision: Precision) -> None:
    """A map of the first references, and the truth beside it, unless both are there; goes on where it broke off."""
    done = folder / f"truth-{places}.npz"
    best, first = Best(np.full(len(of.queries), -np.inf, np.float32), np.zeros(len(of.queries), np.int64)), 0
    if done.exists():
        with np.load(done) as stored:
            best, first = Best(stored["products"], stored["rows"]), int(stored["seen"])
    if first == places:
        return
    atlas = Directory(folder)
    try:
        map_ = atlas.get(_name(places))
    except UnknownMap:
        settings = MapSettings(keep="none")
        map_ = atlas.create(_name(places), encoder.identity, encoder.dimension, settings, precision=precision)
    queries = torch.from_numpy(of.queries)
    with Progress() as progress:
        task = progress.add_task(f"{places:,} places", total=places, completed=first)
        for start, block in of.blocks(places, BLOCK, first):
            best = best.of(queries, block, start)
            map_.enrol([_enrolment(start + offset, row) for offset, row in enumerate(block)])
            progress.advance(task, len(block))
            if (start + len(block)) % (25 * BLOCK) == 0 or start + len(block) == places:
                np.savez(done, products=best.products, rows=best.rows, seen=start + len(block))
    atlas.close()


def _name(places: int) -> str:
    return f"search-{places}"


def _enrolment(row: int, descriptor: Array) -> Enrolment:
    return Enrolment(f"r{row}", PlaceFields(), descriptor, 600, hashlib.sha256(str(row).encode()).digest())


def opened(map_: Map) -> tuple[Snapshot, float]:
    """The map with codes, and the seconds that reading it took, codes that it had not included."""
    map_.edit({"index": "compact"})
    began = time.monotonic()
    return map_.snapshot(), time.monotonic() - began


def flat_index(of: Material, places: int) -> faiss.IndexFlatIP:
    """FAISS's exact search over the first references."""
    index = faiss.IndexFlatIP(of.dimension)
    for _, block in of.blocks(places, BLOCK):
        index.add(block)
    return index


@dataclass(frozen=True)
class Contender:
    """Something that is searched; ``scale`` is what its time is multiplied by."""

    places: int
    name: str
    search: Callable[[Array], object]
    scale: float = 1.0


def measure(contenders: Sequence[Contender], queries: Array, rounds: int) -> list[list[float]]:
    """Milliseconds of every round, by contender; each round asks another query, and the first is not counted."""
    times: list[list[float]] = [[] for _ in contenders]
    for turn in range(rounds + 1):
        for contender, its_times in zip(contenders, times, strict=True):
            query = queries[turn * 7 % len(queries)]
            time.sleep(PAUSE)
            began = time.perf_counter()
            contender.search(query)
            elapsed = 1e3 * (time.perf_counter() - began)
            if turn:
                its_times.append(contender.scale * elapsed)
    return times


def recall(snapshot: Snapshot, queries: Array, truth: NDArray[np.int64]) -> float:
    """How often the first of the ranking is the one that exact float32 products put first."""
    found = [int(snapshot.search(query)[0][0]) for query in queries]
    return float(np.mean(np.array(found) == truth))


def disk_bytes(map_: Map, encoder: Encoder, precision: Precision) -> int:
    """Of a place, with the second stage's cells, which the map measured is spared."""
    cells = Form(precision, encoder.dimension, encoder.local_shape).frame["local"].itemsize
    return map_.storage_status().bytes_per_place + cells


def run(
    folder: Path, encoder: Encoder, of: Material, sizes: Sequence[int], precision: Precision, rounds: int
) -> list[dict[str, Any]]:
    """The figures of every size and tier."""
    contenders: list[Contender] = []
    facts: list[dict[str, Any]] = []
    flats = {places: flat_index(of, places) for places in sorted({min(size, FLAT_PLACES) for size in sizes})}
    atlas = Directory(folder)
    for places in sizes:
        map_, truth = atlas.get(_name(places)), np.load(folder / f"truth-{places}.npz")["rows"]
        snapshot, seconds = opened(map_)
        flat = flats[min(places, FLAT_PLACES)]
        contenders.append(
            Contender(
                places,
                "flat",
                lambda query, flat=flat: flat.search(query[np.newaxis], 1),  # type: ignore[misc]
                places / flat.ntotal,
            )
        )
        facts.append({"memory": 4 * of.dimension, "recall": 1.0})
        contenders.append(Contender(places, "compact", snapshot.search))
        facts.append(
            {
                "memory": snapshot.memory / places,
                "disk": disk_bytes(map_, encoder, precision),
                "recall": recall(snapshot, of.queries, truth),
                "open_seconds": seconds,
            }
        )
    rows = []
    for contender, times, known in zip(contenders, measure(contenders, of.queries, rounds), facts, strict=True):
        low, middle, high = statistics.quantiles(times, n=4)
        about = {"places": contender.places, "tier": contender.name, "milliseconds": middle, "quartiles": [low, high]}
        rows.append({**about, "scaled_by": contender.scale, **known})
    atlas.close()
    return rows


def bars(rows: Sequence[dict[str, Any]], precision: str) -> list[list[str]]:
    """The bars of the larger sizes, each in the precision meant for it: name, measured, verdict."""
    found = []
    for row in rows:
        bar = BARS.get((row["places"], precision))
        if bar is None or row["tier"] == "flat":
            continue
        name = f"{row['places']:,} {row['tier']}"
        found += [
            [f"{name}: times faster than flat", f"{row['faster']:.0f}", verdict(row["faster"], bar.faster, True)],
            [f"{name}: recall@1", f"{row['recall']:.4f}", verdict(row["recall"], bar.recall, True)],
            [f"{name}: bytes in memory a place", f"{row['memory']:.0f}", verdict(row["memory"], bar.memory)],
            [f"{name}: bytes on disk a place", f"{row['disk']:.0f}", verdict(row["disk"], bar.disk)],
        ]
    times = {(row["places"], row["tier"]): row["milliseconds"] for row in rows}
    if (MILLION, "compact") in times and (100_000, "compact") in times:
        growth = times[MILLION, "compact"] / times[100_000, "compact"]
        found.append(["growth from 100,000 to 1,000,000", f"{growth:.2f}", verdict(growth, GROWTH)])
    return found


def show(name: str, rows: Sequence[dict[str, Any]], figures: dict[str, Any]) -> None:
    """Print the tables and keep the figures."""
    flat = {row["places"]: row["milliseconds"] for row in rows if row["tier"] == "flat"}
    table = []
    for row in rows:
        row["faster"] = flat[row["places"]] / row["milliseconds"]
        scaled = ", scaled" if row["scaled_by"] > 1 else ""
        stored = [f"{row['memory']:.0f}", f"{row.get('disk', 0):.0f}"]
        what = f"{row['places']:,} {row['tier']}{scaled}"
        table.append([what, row["milliseconds"], f"{row['faster']:.1f}", f"{row['recall']:.4f}", *stored])
    columns = ["places and tier", "ms", "times faster", "recall@1", "memory, B", "disk, B"]
    title = f"one query; medians of {figures['rounds']} rounds; memory and disk of a place"
    report(name, title, columns, table, {"rows": rows, **figures})
    for line in bars(rows, figures["precision"]):
        print(f"{line[0]:<50} {line[1]:>8}   {line[2]}")


def main(
    places: Annotated[list[int] | None, typer.Option(help="Sizes; default 1 000, 10 000 and 100 000.")] = None,
    million: Annotated[bool, typer.Option("--million", help="100 000 and 1 000 000 places, compressed.")] = False,
    rounds: int = 30,
    queries: Annotated[int, typer.Option(help="Spread evenly over all there are.")] = 1040,
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    cache: Annotated[Path, typer.Option(help="Where encoded photographs are stored.")] = Path(".cache/references"),
    keep: Annotated[Path | None, typer.Option(help="Where maps lie, used again when they are there.")] = None,
) -> None:
    """Measure and report."""
    share_cores(cores())
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    of = material(datasets, encoder, cache)
    queried = np.unique(np.linspace(0, len(of.queries) - 1, min(queries, len(of.queries))).astype(int))
    of = replace(of, queries=of.queries[queried], walks=of.walks[queried])
    sizes = [100_000, MILLION] if million else places or [1000, 10_000, 100_000]
    precision: Precision = "compressed" if million else "half"
    with ExitStack() as stack:
        folder = keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        for size in sizes:
            write_map(folder, encoder, of, size, precision)
        rows = run(folder, encoder, of, sizes, precision, rounds)
    figures = {"encoder": encoder.identity, "precision": precision, "rounds": rounds, "queries": len(of.queries)}
    show("search-million" if million else "search", rows, figures)


if __name__ == "__main__":
    typer.run(main)
