"""The engines ``files`` and ``postgres`` side by side: enrolment, searches, a search right after a write, a late start.

    python -m benchmarks.cluster.engines [--places 20000]        # the storage alone
    python -m benchmarks.cluster.engines --service               # whole services, with 1 and 8 robots

Descriptors change little from one place to the next, as on a drive, and the queries drive along the map, so that rows
that were read for one query are used by the next.  *Cold* is the first drive of a service, *warm* the second.  Both
engines take turns, and medians are compared.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.checkouts import BATCH, ROOT, enrol, load, running
from benchmarks.frames import camera_frames
from benchmarks.report import report, verdict
from core.maps.records import Enrolment, MapSettings
from core.places import PlaceFields
from core.store import Directory, Map, Store
from core.store.cluster import Cluster
from core.threads import cores, share_cores
from tests.servers.postgres import running_postgres

DIMENSION, LOCAL = 16_384, (196, 40)
LIKE = 0.97
"""Cosine of the descriptors of consecutive places."""

STEP = 7
"""Places between two queries of a drive."""

ENGINES = ("files", "postgres")
Times = Mapping[str, dict[str, list[float]]]


class Drive:
    """Places along a drive, the same each time they are asked for."""

    def __init__(self, seed: int = 1) -> None:
        self._random = np.random.default_rng(seed)
        self._last = self._unit()
        self.local = self._random.integers(-127, 128, LOCAL).astype(np.int8)

    def _unit(self) -> NDArray[np.float32]:
        made = self._random.standard_normal(DIMENSION, dtype=np.float32)
        return np.asarray(made / np.linalg.norm(made), np.float32)

    def descriptors(self, count: int) -> NDArray[np.float32]:
        """The next descriptors, float32 [count, D]."""
        found = np.empty((count, DIMENSION), np.float32)
        for at in range(count):
            mixed = LIKE * self._last + (1 - LIKE**2) ** 0.5 * self._unit()
            self._last = found[at] = mixed / np.linalg.norm(mixed)
        return found


def frames_of(descriptors: NDArray[np.float32], local: NDArray[np.int8], first: int) -> list[Enrolment]:
    """Places of a drive."""
    fields = PlaceFields(sequence="drive")
    return [
        Enrolment(f"p{first + at:07d}", fields, descriptor, 9, (first + at).to_bytes(32, "big"), local)
        for at, descriptor in enumerate(descriptors)
    ]


def seconds_of(work: Callable[[], object]) -> float:
    """The duration of some work."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def filled(stores: Mapping[str, Store], places: int, found: Times) -> NDArray[np.float32]:
    """Enrol a drive in a map of each store; returns the queries, float32 [n, D]."""
    settings = MapSettings(keep="none", same_place_frames=0)
    maps = {name: store.create("drive", "e@1", DIMENSION, settings, LOCAL) for name, store in stores.items()}
    drive, queries = Drive(), []
    for turn, first in enumerate(range(0, places, BATCH)):
        descriptors = drive.descriptors(min(BATCH, places - first))
        queries.append(descriptors[::STEP])
        items = frames_of(descriptors, drive.local, first)
        for name in ENGINES[:: 1 if turn % 2 else -1]:
            taken = seconds_of(lambda name=name, items=items: maps[name].enrol(items))  # type: ignore[misc]
            found[name]["enrolment, places/s"].append(len(items) / taken)
    noise = np.random.default_rng(2).standard_normal((len(np.concatenate(queries)), DIMENSION), dtype=np.float32)
    return np.asarray(np.concatenate(queries) + 0.5 * noise / DIMENSION**0.5, np.float32)


def searched(map_: Map, query: NDArray[np.float32]) -> NDArray[np.int64]:
    """The best rows, of which the cells are read as the second stage reads them."""
    scope = map_.scope()
    ((rows, _),) = scope.search(query[np.newaxis])
    scope.snapshot.locals_at(rows[:30])
    return rows


def storage(places: int, found: Times, drives: int) -> None:
    """Measure the storage alone."""
    share_cores(cores())
    with ExitStack() as stack:
        server = stack.enter_context(running_postgres())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stores: dict[str, Store] = {"files": Directory(folder), "postgres": Cluster(server.address)}
        queries = filled(stores, places, found)
        queries = queries[: min(len(queries), 200)]
        stores["files"].close()
        for name, opened in (
            ("files", lambda: Directory(folder)),
            ("postgres", lambda: Cluster(server.address)),
        ):
            stores[name].close()
            made: list[Store] = []

            def ready(opened: Callable[[], Store] = opened, made: list[Store] = made) -> None:
                made.append(opened())
                made[0].get("drive").snapshot()

            found[name]["a service that starts later, s"].append(seconds_of(ready))
            stores[name] = made[0]
            stack.callback(made[0].close)
        maps = {name: store.get("drive") for name, store in stores.items()}
        first = {name: [int(searched(maps[name], query)[0]) for query in queries[:1]] for name in ENGINES}
        assert first["files"] == first["postgres"]
        for drive in range(drives):
            kind = "cold" if drive == 0 else "warm"
            for turn, query in enumerate(queries):
                for name in ENGINES[:: 1 if turn % 2 else -1]:
                    taken = seconds_of(lambda name=name, query=query: searched(maps[name], query))  # type: ignore[misc]
                    found[name][f"search, {kind}, ms"].append(1e3 * taken)
        with ThreadPoolExecutor(8) as pool:
            for _ in range(drives):
                for name in ENGINES:
                    work = lambda query, name=name: searched(maps[name], query)  # noqa: E731
                    taken = seconds_of(lambda work=work: list(pool.map(work, queries)))  # type: ignore[misc]
                    found[name]["8 at once, searches/s"].append(len(queries) / taken)
        other = Drive(9)
        for number, query in enumerate(queries[:40]):
            (item,) = frames_of(other.descriptors(1), other.local, 10**6 + number)
            for name in ENGINES:
                maps[name].enrol([item])
                taken = seconds_of(lambda name=name, query=query: searched(maps[name], query))  # type: ignore[misc]
                found[name]["search right after a write, ms"].append(1e3 * taken)


def services(places: int, found: Times, rounds: int) -> None:
    """Measure whole services: encoding, search, second stage."""
    frames, _ = camera_frames(48)
    with running_postgres() as server, ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (folder / "frames").mkdir()
        for index, frame in enumerate(frames):
            (folder / "frames" / f"{index:03d}.jpg").write_bytes(frame)
        given = {"files": {}, "postgres": {"PLACEREC_DATABASE": server.address}}
        clients = {name: stack.enter_context(running(ROOT, folder / name, given[name]))[0] for name in ENGINES}
        for client in clients.values():
            client.post("/v1/maps", json={"id": "lab", "keep": "none"}).raise_for_status()
        for first in range(0, places, BATCH):
            for name, client in clients.items():
                count = min(BATCH, places - first)
                taken = seconds_of(partial(enrol, client, "lab", frames, first, count))
                found[name]["enrolment with encoding, places/s"].append(count / taken)
        for turn in range(rounds):
            for name in ENGINES[:: 1 if turn % 2 else -1]:
                for robots in (1, 8):
                    seen = load(str(clients[name].base_url), folder / "frames", robots, 4.0)
                    found[name][f"{robots} robots, answers/s"].append(len(seen["milliseconds"]) / seen["seconds"])
                    found[name][f"{robots} robots, p50 ms"].append(float(np.median(seen["milliseconds"])))


BARS = {
    "1 robots, p50 ms": (1.4, False),
    "8 robots, answers/s": (0.8, True),
    "search, warm, ms": (1.3, False),
    "enrolment, places/s": (0.5, True),
}
"""The largest ratio of ``postgres`` to ``files``, or the least."""


@contextmanager
def collected() -> Iterator[Times]:
    """Measurements by engine and by name."""
    yield {name: defaultdict(list) for name in ENGINES}


def main(
    places: Annotated[int, typer.Option(help="Places of the map.")] = 20_000,
    service: Annotated[bool, typer.Option(help="Whole services in place of the storage.")] = False,
    rounds: Annotated[int, typer.Option(help="Drives along the map, or turns of each service.")] = 4,
) -> None:
    """Measure and report."""
    with collected() as found:
        if service:
            services(min(places, 600), found, rounds)
        else:
            storage(places, found, rounds)
    rows: list[list[object]] = []
    for name in found["files"]:
        here, there = (statistics.median(found[engine][name]) for engine in ENGINES)
        bar = BARS.get(name)
        rows.append([name, here, there, there / here, "" if bar is None else verdict(there / here, *bar)])
    title = f"files and postgres, {min(places, 600) if service else places:,} places, medians"
    kind = "service" if service else "storage"
    figures = {"places": places, "found": {name: dict(values) for name, values in found.items()}}
    report(f"cluster_engines_{kind}", title, ["", *ENGINES, "ratio", "bar"], rows, figures)


if __name__ == "__main__":
    typer.run(main)
