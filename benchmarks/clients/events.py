"""The cost of live events for a query: with nobody listening, and with listeners, as the whole request sees it.

    python -m benchmarks.clients.events [--other ../other-checkout]

One client asks maps of the same places in turn, one request each, so that whatever disturbs one disturbs all: a map
that nobody listens to, maps with one and with sixteen listeners, a map with a listener that wants pictures and, if one
is given, the same map in a service of another checkout.  The differences are medians of the differences of a turn.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

import httpx
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.checkouts import BATCH, ROOT, enrol, running
from benchmarks.frames import camera_frames
from benchmarks.report import report

LISTENERS = {"nobody listens": (0, False), "1 listener": (1, False), "16 listeners": (16, False), "pictures": (1, True)}
"""How many listen to a map, and whether they want pictures."""


@contextmanager
def listener(client: httpx.Client, map_id: str, pictures: bool) -> Iterator[None]:
    """Somebody who listens to a map, and reads all events."""
    stop = threading.Event()

    def read() -> None:
        url = f"{str(client.base_url).rstrip('/')}/v1/maps/{map_id}/events"
        with httpx.stream("GET", url, params={"pictures": pictures}, timeout=60) as stream:
            for _ in stream.iter_raw():
                listening.set()
                if stop.is_set():
                    return

    listening = threading.Event()
    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    assert listening.wait(30)
    try:
        yield
    finally:
        stop.set()


def main(
    other: Annotated[Path | None, typer.Option(help="A checkout without events, to compare with.")] = None,
    turns: Annotated[int, typer.Option(help="Requests to each map.")] = 300,
    places: Annotated[int, typer.Option(help="Places of each map.")] = 320,
) -> None:
    """Measure, print a table and write JSON."""
    frames, described = camera_frames(48)
    found: dict[str, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as temporary, ExitStack() as stack:
        client, _, _ = stack.enter_context(running(ROOT, Path(temporary) / "this"))
        contestants: dict[str, tuple[httpx.Client, str]] = {}
        for number, name in enumerate(LISTENERS):
            contestants[name] = (client, f"map-{number}")
        if other is not None:
            there, _, _ = stack.enter_context(running(other.resolve(), Path(temporary) / "other"))
            contestants["other checkout"] = (there, "lab")
        for service, map_id in contestants.values():
            service.post("/v1/maps", json={"id": map_id, "keep": "thumbnail"}).raise_for_status()
            for first in range(0, places, BATCH):
                enrol(service, map_id, frames, first, min(BATCH, places - first))
        for name, (count, pictures) in LISTENERS.items():
            for _ in range(count):
                stack.enter_context(listener(client, contestants[name][1], pictures))
        names = list(contestants)
        for turn in range(-20, turns):
            for name in [*names[turn % len(names) :], *names[: turn % len(names)]]:
                service, map_id = contestants[name]
                frame = frames[turn % len(frames)]
                began = time.perf_counter()
                answer = service.post(f"/v1/maps/{map_id}/query", content=frame, headers={"Content-Type": "image/jpeg"})
                answer.raise_for_status()
                if turn >= 0:
                    found[name].append(1e3 * (time.perf_counter() - began))
    base = "nobody listens" if other is None else "other checkout"
    rows: list[list[object]] = []
    for name, values in found.items():
        difference = np.subtract(values, found[base])
        low, middle, high = np.percentile(_medians(difference), [2.5, 50, 97.5])
        rows.append([name, float(np.median(values)), float(np.percentile(values, 95)), middle, low, high])
    columns = ["", "p50 ms", "p95 ms", f"against {base}, ms", "from", "to"]
    title = f"A query while somebody listens ({described}, {places} places, {turns} turns)"
    report("events", title, columns, rows, {"milliseconds": found})


def _medians(differences: NDArray[np.float64]) -> NDArray[np.float64]:
    """Medians of samples drawn with replacement: how sure the median is."""
    random = np.random.default_rng(0)
    return np.asarray(np.median(random.choice(differences, (2000, len(differences))), axis=1))


if __name__ == "__main__":
    typer.run(main)
