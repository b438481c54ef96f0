"""The cost of one map of a data directory: enrolling, querying, opening.

    python -m benchmarks.maps.store [--places 20000]

Frames are made up in the sizes of real ones; the time of making them is in that of enrolling.  A query is all that the
service reads of the store.  *Cold*: the system has nothing of the files in memory, as far as it lets us.
"""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.maps.opening import forget_cached
from benchmarks.process import median
from benchmarks.report import report
from core.geometry.keypoints import LENGTH, SHARES, Keypoints
from core.maps import Enrolment, MapSettings
from core.places import PlaceFields, Pose
from core.store import Directory, Map
from core.threads import cores, share_cores

Array = NDArray[np.float32]

MAP, DIMENSION, LOCAL = "store", 16_384, (512, 128)
BATCH, ALONE, QUERIES, ROBOTS = 64, 40, 60, 16
KINDS = 64  # directions that all descriptors are mixed from


class Frames:
    """Frames by their number, the same each time they are asked for."""

    def __init__(self) -> None:
        random = np.random.default_rng(0)
        kinds = random.standard_normal((KINDS, DIMENSION), dtype=np.float32)
        self._kinds = kinds / np.linalg.norm(kinds, axis=1, keepdims=True)
        self._cells = random.integers(-90, 90, (KINDS, *LOCAL), dtype=np.int8)
        points = random.integers(0, SHARES, (300, 2), dtype=np.uint16)
        self._keypoints = Keypoints(640, 480, points, random.integers(1, 128, (300, LENGTH), dtype=np.int8))

    def descriptor(self, number: int) -> Array:
        """One of length 1, float32 [D]."""
        share = 0.04 * (1 + number // KINDS % 5)
        mixed = self._kinds[number % KINDS] + share * self._kinds[(7 * number + 1) % KINDS]
        return np.asarray(mixed / np.linalg.norm(mixed), np.float32)

    def enrolment(self, number: int) -> Enrolment:
        """The place of a frame."""
        fields = PlaceFields(pose=Pose(x=float(number), y=0.0), sequence=f"s{number // 500}")
        digest, cells = hashlib.sha256(f"{number}".encode()).digest(), self._cells[number % KINDS]
        item = Enrolment(f"p{number}", fields, self.descriptor(number), 100, digest, cells, thumbnail=bytes(3000))
        return replace(item, keypoints=self._keypoints)


def query(map_: Map, descriptor: Array) -> bool:
    """All that an answer reads of the store; whether places were found."""
    scope = map_.scope()
    ((rows, _),) = scope.search(descriptor[np.newaxis])
    scope.snapshot.locals_at(rows[:60])
    scope.snapshot.whereabouts_at(rows[:100])
    map_.places_at(rows[:10].tolist())
    map_.keypoints_at(rows[:20].tolist())
    map_.glances_at(rows[:60].tolist())
    return len(rows) > 0


def milliseconds(work: Callable[[int], object], count: int) -> float:
    """The median of ``work(0)``, ``work(1)`` and so on."""
    moments = [time.perf_counter()]
    for number in range(count):
        work(number)
        moments.append(time.perf_counter())
    return 1e3 * median(list(np.diff(moments)))


def measured(folder: Path, places: int) -> dict[str, float]:
    """The figures of a map that is made in a new data directory."""
    frames, atlas = Frames(), Directory(folder)
    map_ = atlas.create(MAP, "made-up@" + "0" * 64, DIMENSION, MapSettings(keep="thumbnail"), LOCAL)
    batches = [range(first, min(places, first + BATCH)) for first in range(0, places, BATCH)]
    together = milliseconds(lambda at: map_.enrol([frames.enrolment(one) for one in batches[at]]), len(batches)) / BATCH
    alone = milliseconds(lambda at: map_.enrol([frames.enrolment(10**6 + at)]), ALONE)
    queries = [frames.descriptor(3 * number) for number in range(QUERIES)]
    milliseconds(lambda at: query(map_, queries[at]), 20)
    one = milliseconds(lambda at: query(map_, queries[at]), QUERIES)
    with ThreadPoolExecutor(ROBOTS) as pool:
        many = milliseconds(lambda _: list(pool.map(lambda of: query(map_, of), ROBOTS * queries)), 1)
    both = milliseconds(lambda at: map_.enrol([frames.enrolment(2 * 10**6 + at)]) and query(map_, queries[at]), ALONE)
    atlas.close()
    openings: dict[bool, list[float]] = {True: [], False: []}
    for cold in 3 * (True, False):
        if cold:
            forget_cached(folder)
        began, again = time.perf_counter(), Directory(folder)
        query(again.get(MAP), queries[5])
        openings[cold].append(1e3 * (time.perf_counter() - began))
        again.close()
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return {
        "enrolled alone, ms": alone,
        f"enrolled in {BATCH}s, ms a place": together,
        "query, ms": one,
        f"query by {ROBOTS} threads, ms each": many / (ROBOTS * QUERIES),
        "enrolled and queried, ms": both,
        "opened and queried, cold, ms": min(openings[True]),
        "opened and queried, warm, ms": min(openings[False]),
        "disk, KB a place": size / 1024 / (places + 2 * ALONE),
    }


def main(places: Annotated[int, typer.Option(min=BATCH, help="Places of the map.")] = 20_000) -> None:
    """Measure, print a table and write JSON."""
    share_cores(cores())
    with tempfile.TemporaryDirectory() as folder:
        found = measured(Path(folder) / "data", places)
    report("store", f"a map of {places:,} places", ["", "measured"], list(found.items()), {"figures": found})


if __name__ == "__main__":
    typer.run(main)
