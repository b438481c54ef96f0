"""The console's requests for a large map: its plan, pages of filtered places, forgetting many places.

    python -m benchmarks.console.endpoints [--places 100000] [--rounds 5]

A server of its own holds a map of made-up descriptors, with poses, times, three traverses and metadata.  ``plan`` is
the first one after a write, ``again`` the next, ``304`` one that the caller has; all are taken as a browser takes them,
compressed.  ``others`` is the longest time of /livez while plans are made: whether they keep the event loop waiting.
``memory`` is what the process has grown by.
"""

from __future__ import annotations

import tempfile
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from statistics import median
from typing import Annotated

import httpx
import numpy as np
import typer

from benchmarks.process import Process, service
from benchmarks.report import report, verdict
from core.maps import Enrolment, MapSettings
from core.places import PlaceFields, Pose
from core.store import Directory

ENCODER, DIMENSION, BATCH = "made-up@" + "0" * 64, 8, 5000
BEGAN = datetime(2026, 11, 20, tzinfo=UTC)


def fill(folder: Path, places: int) -> None:
    """A data directory with a map."""
    random = np.random.default_rng(0)
    atlas = Directory(folder)
    lab = atlas.create("lab", ENCODER, DIMENSION, MapSettings())
    for first in range(0, places, BATCH):
        items = []
        for number in range(first, min(places, first + BATCH)):
            fields = PlaceFields(
                pose=Pose(x=number * 0.37, y=float(random.normal()), heading=number % 360),
                sequence=f"traverse-{number * 3 // places}",
                timestamp=BEGAN + timedelta(seconds=number),
                metadata={"floor": number % 5},
            )
            descriptor = random.standard_normal(DIMENSION, dtype=np.float32)
            items.append(Enrolment(f"place-{number}", fields, descriptor, 600, random.bytes(32)))
        lab.enrol(items)
    atlas.close()


def seconds(client: httpx.Client, method: str, path: str, status: int = 200, **more: object) -> float:
    """How long one request takes until its answer is read; it must have this status."""
    began = time.perf_counter()
    response = client.request(method, path, **more)  # type: ignore[arg-type]
    took = time.perf_counter() - began
    assert response.status_code == status, response.text[:500]
    return took


class Liveness:
    """Asks /livez again and again, as long as it is open."""

    def __init__(self, url: str) -> None:
        self.longest, self._stopping = 0.0, threading.Event()
        self._thread = threading.Thread(target=self._ask, args=(url,))

    def _ask(self, url: str) -> None:
        with httpx.Client(base_url=url) as client:
            while not self._stopping.wait(0.005):
                self.longest = max(self.longest, seconds(client, "GET", "/livez"))

    def __enter__(self) -> Liveness:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()


def measure(server: Process, rounds: int) -> dict[str, float]:
    """Seconds of each request, the median of some rounds, and MB."""
    client, lab = server.client, "/v1/maps/lab"
    seconds(client, "GET", f"{lab}/places", params={"limit": "1"})  # opens the map
    before = server.memory()
    first, again = [], []
    with Liveness(str(client.base_url)) as liveness:
        for number in range(rounds):
            client.patch(f"{lab}/places/place-0", json={"pose": {"x": number}}).raise_for_status()
            first.append(seconds(client, "GET", f"{lab}/plan"))
            again.append(seconds(client, "GET", f"{lab}/plan"))
        others = liveness.longest
    with client.stream("GET", f"{lab}/plan") as plan:
        size = sum(len(part) for part in plan.iter_raw())
        tag = plan.headers["etag"]
    known = [seconds(client, "GET", f"{lab}/plan", 304, headers={"If-None-Match": tag}) for _ in range(rounds)]
    grown = server.memory() - before
    last = {"after": (BEGAN + timedelta(days=1)).isoformat(), "where": '{"floor": 3}', "limit": "100"}
    filtered = [seconds(client, "GET", f"{lab}/places", params=last) for _ in range(rounds)]
    ids = [f"place-{number}" for number in range(0, 20_000, 2)]
    dry = seconds(client, "POST", f"{lab}/places:delete", json={"ids": ids})
    forgotten = seconds(client, "POST", f"{lab}/places:delete", json={"ids": ids, "dry_run": False})
    return {
        "plan": median(first),
        "again": median(again),
        "304": median(known),
        "megabytes": size / 1e6,
        "others": others,
        "memory": grown,
        "filtered page": median(filtered),
        "dry run of 10 000": dry,
        "forget 10 000": forgotten,
    }


def main(
    places: Annotated[int, typer.Option(help="Places of the map; at least 20 000.")] = 100_000,
    rounds: Annotated[int, typer.Option(help="Requests of each kind.")] = 5,
) -> None:
    """Measure, print a table and write JSON."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        fill(folder / "data", places)
        with service(folder / "data") as server:
            found = measure(server, rounds)
    limits = {"plan": 1.0, "again": 0.1, "304": 0.1}
    rows = [(name, value, verdict(value, limits[name]) if name in limits else "") for name, value in found.items()]
    report(
        "console", f"The console's requests of a map of {places} places", ["", "s or MB", ""], rows, {"found": found}
    )


if __name__ == "__main__":
    typer.run(main)
