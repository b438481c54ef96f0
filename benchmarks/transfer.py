"""What a map as a file costs: time and memory of taking a moment, of sending it, of checking and building it.

    python -m benchmarks.transfer [--places 2000 8000] [--folder DIR]

Each size runs in a process of its own on made-up descriptors in the shape of the default encoder's, with thumbnails of
3 KB.  ``memory`` is the process's peak while it exports and imports, over what it held before.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import shutil
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from core.places import PlaceFields, Pose
from core.storage import Atlas, Enrolment, Map, MapSettings
from core.storage.archives.building import build
from core.storage.archives.reading import Archive, check
from core.storage.archives.virtual_archive import CHUNK_BYTES

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
            picture = random.bytes(3000)
            items.append(Enrolment(f"p{number}", fields, descriptor, 600, random.bytes(32), local, thumbnail=picture))
        map_.enrol(items)


def peak() -> float:
    """The most memory that this process ever held, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def made(folder: Path, places: int) -> None:
    """A data directory with a map."""
    atlas = Atlas(folder / "data")
    fill(atlas.create("lab", ENCODER, DIMENSION, MapSettings(index="compact"), LOCAL), places)
    atlas.close()


def measured(folder: Path) -> None:
    """Export the map, check the file, import it; tell what each took."""
    atlas, file = Atlas(folder / "data"), folder / "lab.tar"
    lab = atlas.get("lab")
    before, began = peak(), time.perf_counter()
    virtual = lab.exporter.into(folder / "kept")
    taken = time.perf_counter()
    with file.open("wb") as out:
        position = 0
        while data := virtual.read(position, CHUNK_BYTES):
            out.write(data)
            position += len(data)
    sent = time.perf_counter()
    with Archive(file) as archive:
        check(archive)
        checked = time.perf_counter()
        with atlas.building("copy") as unfinished:
            build(archive, unfinished, "copy")
    built = time.perf_counter()
    mb, kept = virtual.size / 1e6, sum(p.stat().st_size for p in virtual.folder.iterdir() if p.suffix != ".seg") / 1e6
    print(
        f"{lab.count_places()} places, {mb:.0f} MB: taken in {taken - began:.1f} s ({kept:.0f} MB on disk), "
        f"read in {sent - taken:.1f} s, checked in {checked - sent:.1f} s, built in {built - checked:.1f} s; "
        f"memory +{peak() - before:.0f} MB",
        flush=True,
    )
    virtual.discard()
    atlas.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, nargs="+", default=[2000, 8000])
    parser.add_argument("--folder", type=Path, help="where there is room for three times the map")
    arguments = parser.parse_args()
    for places in arguments.places:
        folder = Path(tempfile.mkdtemp(dir=arguments.folder))
        try:
            for work in (made, measured):
                process = multiprocessing.get_context("spawn").Process(
                    target=work, args=(folder, places) if work is made else (folder,)
                )
                process.start()
                process.join()
                if process.exitcode:
                    raise SystemExit(process.exitcode)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
