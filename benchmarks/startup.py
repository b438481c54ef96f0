"""Time to /readyz, memory without maps, and the most memory that enrolling and searching 2000 places takes.

python -m benchmarks.startup
"""

from __future__ import annotations

import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from benchmarks.process import Process, service
from benchmarks.report import report, verdict
from service.commands.timing.samples import jpeg, sample_frame

READY_LIMIT, EMPTY_READY_LIMIT = 6.0, 2.5
MEMORY_LIMIT, EMPTY_MEMORY_LIMIT = 800.0, 250.0
SENDERS = 4


def frame(index: int) -> bytes:
    """The JPEG file of a place: one of 50 sample frames, mirrored, cropped and lit in its own way."""
    drawn = sample_frame(index % 50)
    random = np.random.default_rng(index)
    top, left = random.integers(0, 100, 2)
    drawn = drawn[top : top + 360, left : left + 480]
    if random.random() < 0.5:
        drawn = drawn[:, ::-1]
    return jpeg(np.asarray(cv2.convertScaleAbs(drawn, alpha=float(random.uniform(0.7, 1.2))), np.uint8))


def enrol(process: Process, places: int) -> float:
    """Send frames; seconds that it took."""
    process.client.post("/v1/maps", json={"id": "benchmark"}).raise_for_status()

    def send(index: int) -> None:
        path = f"/v1/maps/benchmark/places/p{index:05d}"
        answer = process.client.put(path, content=frame(index), headers={"Content-Type": "image/jpeg"})
        answer.raise_for_status()

    began = time.monotonic()
    with ThreadPoolExecutor(SENDERS) as senders:
        list(senders.map(send, range(places)))
    return time.monotonic() - began


def query(process: Process) -> float:
    """Ask once, which opens the map; seconds that it took."""
    began = time.monotonic()
    headers = {"Content-Type": "image/jpeg"}
    process.client.post("/v1/maps/benchmark/query", content=frame(3), headers=headers).raise_for_status()
    return time.monotonic() - began


def main(places: Annotated[int, typer.Option(min=1)] = 2000, starts: Annotated[int, typer.Option(min=1)] = 3) -> None:
    """Enrol over HTTP, then start again on what was enrolled, and without maps."""
    with tempfile.TemporaryDirectory() as folder:
        data_dir = Path(folder)
        with service(data_dir) as process:
            first = process.ready
            seconds = enrol(process, places)
            query(process)
            enrolling = process.peak_memory()
        ready, opened, serving = [], [], []
        for _ in range(starts):
            with service(data_dir) as process:
                ready.append(process.ready)
                opened.append(query(process))
                serving.append(process.peak_memory())
    ready_empty, empty = [], []
    for _ in range(starts):
        with tempfile.TemporaryDirectory() as folder, service(Path(folder)) as process:
            ready_empty.append(process.ready)
            empty.append(process.memory())
    warm, without = float(np.median(ready)), float(np.median(ready_empty))
    rows = [
        ("first start, s", first, ""),
        ("start on a warm cache, s", warm, verdict(warm, READY_LIMIT)),
        ("start without maps, s", without, verdict(without, EMPTY_READY_LIMIT)),
        ("memory without maps, MB", max(empty), verdict(max(empty), EMPTY_MEMORY_LIMIT)),
        (f"first query, which opens {places} places, s", float(np.median(opened)), ""),
        (f"enrolling {places} places, s", seconds, f"{places / seconds:.1f} a second"),
        ("peak memory, enrolment included, MB", enrolling, verdict(enrolling, MEMORY_LIMIT)),
        ("peak memory, started again, MB", max(serving), verdict(max(serving), MEMORY_LIMIT)),
    ]
    figures = {
        "places": places,
        "ready_seconds": ready,
        "first_ready_seconds": first,
        "without_maps": {"ready_seconds": ready_empty, "megabytes": empty},
        "enrolment_seconds": seconds,
        "peak_megabytes": {"enrolling": enrolling, "serving": max(serving)},
    }
    report("startup", "Start and memory", ["", "", ""], rows, figures)


if __name__ == "__main__":
    typer.run(main)
