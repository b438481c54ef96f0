"""The cost of a map as a file: time and memory of writing it, of checking it, of building a map from it.

    python -m benchmarks.transfer [--places 2000 --places 8000] [--folder DIR]

Each size runs in a process of its own on made-up descriptors in the shape of the default encoder's, with thumbnails of
3 KB.  ``memory`` is the process's peak while it exports and imports, over what it held before.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.process import peak_memory
from benchmarks.report import report
from core.maps import Enrolment, MapSettings
from core.maps.archives.reading import Archive, check
from core.places import PlaceFields, Pose
from core.store import Directory, Map

ENCODER, DIMENSION, LOCAL = "made-up@" + "0" * 64, 16_384, (169, 192)
BATCH = 64


def fill(map_: Map, places: int) -> None:
    """Enrol places of random descriptors."""
    random = np.random.default_rng(0)
    for first in range(0, places, BATCH):
        items = []
        for number in range(first, min(places, first + BATCH)):
            descriptor = random.standard_normal(DIMENSION, dtype=np.float32)
            descriptor /= np.linalg.norm(descriptor)
            local = random.integers(-128, 128, LOCAL, np.int8)
            fields = PlaceFields(pose=Pose(x=number, y=0), sequence="s", timestamp=datetime.now(UTC))
            thumbnail = random.bytes(3000)
            items.append(Enrolment(f"p{number}", fields, descriptor, 600, random.bytes(32), local, thumbnail=thumbnail))
        map_.enrol(items)


def made(folder: Path, places: int) -> None:
    """A data directory with a map."""
    atlas = Directory(folder / "data")
    fill(atlas.create("lab", ENCODER, DIMENSION, MapSettings(index="compact"), LOCAL), places)
    atlas.close()


def measured(folder: Path) -> dict[str, float]:
    """Export the map, check the file, import it: seconds of each, MB (10^6 bytes) of the file and of memory."""
    atlas = Directory(folder / "data")
    lab = atlas.get("lab")
    before, began = peak_memory(os.getpid()), time.perf_counter()
    made = lab.exporter.write(folder / "lab.tar")
    written = time.perf_counter()
    with Archive(made.path) as archive:
        check(archive)
        checked = time.perf_counter()
        atlas.import_map(archive, "copy", lambda _done, _all: None, lambda _picture: None, 1 << 20, lambda _count: None)
    built = time.perf_counter()
    found = {
        "file": made.size / 1e6,
        "written": written - began,
        "checked": checked - written,
        "built": built - checked,
        "memory": peak_memory(os.getpid()) - before,
    }
    atlas.close()
    return found


def main(
    places: Annotated[list[int] | None, typer.Option(help="Sizes; default 2 000 and 8 000.")] = None,
    folder: Annotated[Path | None, typer.Option(help="Where there is room for three times the map.")] = None,
) -> None:
    """Measure, print a table and write JSON."""
    figures: dict[int, dict[str, float]] = {}
    for size in places or [2000, 8000]:
        with tempfile.TemporaryDirectory(dir=folder) as text:
            _apart(made, Path(text), size)
            figures[size] = _apart(measured, Path(text))
    columns = ["places", "file, MB", "written, s", "checked, s", "built, s", "memory, MB"]
    rows = [(size, *found.values()) for size, found in figures.items()]
    report("transfer", "A map as a file", columns, rows, {"sizes": figures})


def _apart(work: Callable[..., Any], *arguments: object) -> Any:
    """The result of ``work`` in a process of its own, whose peak of memory is that of this work alone."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(work, arguments)


if __name__ == "__main__":
    typer.run(main)
