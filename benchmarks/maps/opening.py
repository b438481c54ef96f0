"""A large map: time to its first query after a start, time of a search, memory and disk a place.

    python -m benchmarks.maps.opening [--places 100000] [--precision half] [--keep FOLDER]

The map is written through the store, of descriptors mixed from those of sample frames.  Then a service is
started on it and queried once, from a cold cache of the system as far as it lets us; and a process of its own opens it
and searches, with and without a filter.
``--keep`` is where the map lies, used again when it is there already.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.process import ROOT, median, memory, service
from benchmarks.report import report, verdict
from core.maps import Precision
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.store import Directory
from service.commands.timing.samples import fill_map, jpeg, sample_frame

MAP = "large"
FIRST_SECONDS = 10.0
MEMORY_BYTES = 8 * 1024
DISK_BYTES = 98_000
SEARCHES = 40
ALLOWED_SHARE = 0.01


def made(folder: Path, places: int, precision: Precision) -> dict[str, Any]:
    """Make the map, unless it is there; how long that took, and what the API shows of it."""
    began = time.monotonic()
    if not (folder / "maps" / MAP).is_dir():
        fill_map(folder, MAP, EncoderCatalogue().get(DEFAULT_ENCODER), places, precision)
    wrote = time.monotonic() - began
    atlas = Directory(folder)
    map_ = atlas.get(MAP)
    map_.rebuild_index()  # which measures its recall
    status, storage = map_.index_status().model_dump(), map_.storage_status().model_dump()
    atlas.close()
    return {"write_seconds": wrote, "index": status, "storage": storage}


def forget_cached(folder: Path) -> None:
    """Ask the system to keep nothing of the files in memory."""
    os.sync()
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def first_query(folder: Path) -> dict[str, float]:
    """Seconds from the start of a service to its first answer from the map."""
    frame = jpeg(sample_frame(3))
    with service(folder) as process:
        began = time.monotonic()
        answer = process.client.post(f"/v1/maps/{MAP}/query", content=frame, headers={"Content-Type": "image/jpeg"})
        answer.raise_for_status()
        queried = time.monotonic() - began
        return {"ready": process.ready, "query": queried, "together": process.ready + queried}


def searched(folder: Path) -> dict[str, float]:
    """Open the map in this process and search it."""
    atlas = Directory(folder)
    before, began = memory(os.getpid()), time.monotonic()
    map_ = atlas.get(MAP)
    snapshot, random = map_.snapshot(), np.random.default_rng(1)
    opened = time.monotonic() - began
    queries = snapshot.descriptors_at(random.choice(snapshot.rows, SEARCHES))
    queries += random.standard_normal(queries.shape, np.float32) * np.float32(0.5) * queries.std()
    allowed = random.random(snapshot.rows) < ALLOWED_SHARE
    times: dict[str, list[float]] = {"cold": [], "all": [], "allowed": []}
    for query in queries:  # the first of each reads the parts of the files that the system has not cached
        for name, mask in (("cold", None), ("all", None), ("all", None), ("allowed", allowed), ("allowed", allowed)):
            began = time.perf_counter()
            snapshot.search(query, mask)
            times[name].append(1e3 * (time.perf_counter() - began))
    taken = 1e6 * (memory(os.getpid()) - before) / len(snapshot)
    atlas.close()
    found = {f"search_{name}": median(values) for name, values in times.items()}
    return {"open_seconds": opened, "bytes_per_place": taken, **found}


def main(
    places: Annotated[int, typer.Option(min=100)] = 100_000,
    precision: Annotated[str, typer.Option(help="half or compressed")] = "half",
    keep: Annotated[Path | None, typer.Option(help="Where the map lies, and stays.")] = None,
    search_only: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Measure, print a table and write JSON."""
    with ExitStack() as stack:
        folder = keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if search_only:
            print(json.dumps(searched(folder)))
            return
        figures = made(folder, places, "compressed" if precision == "compressed" else "half")
        forget_cached(folder)
        figures["first"] = first_query(folder)
        command = [sys.executable, "-m", "benchmarks.maps.opening", "--search-only", "--keep", str(folder)]
        child = subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
        figures["search"] = search = json.loads(child.stdout)
    recall, disk = figures["index"]["recall"], figures["storage"]["bytes_per_place"]
    first = figures["first"]
    rows = [
        ("written, places a second", places / figures["write_seconds"], ""),
        *([("recall@1", recall["at_1"], verdict(recall["at_1"], 0.995, True))] if recall else []),
        ("service ready, s", first["ready"], ""),
        ("first query after that, s", first["query"], ""),
        ("start to first answer, s", first["together"], verdict(first["together"], FIRST_SECONDS)),
        ("opening in process, s", search["open_seconds"], ""),
        ("search, rows not yet read, ms", search["search_cold"], ""),
        ("search, ms", search["search_all"], ""),
        (
            "search, 1 % allowed, ms",
            search["search_allowed"],
            verdict(search["search_allowed"], search["search_all"]),
        ),
        ("memory a place, bytes", search["bytes_per_place"], verdict(search["bytes_per_place"], MEMORY_BYTES)),
        ("disk a place, bytes", disk, verdict(disk, DISK_BYTES)),
    ]
    title = f"a map of {places} places, {precision}"
    name = f"opening-{places}-{precision}"
    report(name, title, ("what", "measured", "limit"), rows, {"places": places, "precision": precision, **figures})


if __name__ == "__main__":
    typer.run(main)
