"""The share of a job's processor time that remains in the front when others encode: is it worth a cluster?

    python -m benchmarks.ray_serve.jobs

Each part runs by itself, in this process, on a map of two traverses; its time is divided by its frames.  Encoding is
what a Ray cluster takes over.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.frames import camera_frames
from benchmarks.report import report
from core.frames.images import decode
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.places import PlaceFields
from core.recognition.calibration import queries_from_map, run_trials
from core.store import Directory
from service.commands.timing.samples import sample_descriptors, write_map
from service.upkeep.alignment import _shared


def processor_milliseconds(work: Callable[[], object]) -> float:
    """Of all threads of this process."""
    before = time.process_time()
    work()
    return 1e3 * (time.process_time() - before)


def main(frames: Annotated[int, typer.Option(min=20, help="Of each of two traverses.")] = 500) -> None:
    """Measure and compare."""
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    pictures, content = camera_frames(32)
    for data in pictures[:4]:
        encoder.encode(decode(data))
    encoding = processor_milliseconds(lambda: [encoder.encode(decode(data)) for data in pictures]) / len(pictures)
    described = list(sample_descriptors(encoder, 2 * frames))
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder)

        def fields(index: int) -> PlaceFields:
            return PlaceFields(sequence="first" if index < frames else "second")

        storing = processor_milliseconds(lambda: write_map(store, "lab", encoder, described, fields=fields))
        atlas = Directory(store)
        map_ = atlas.get("lab")
        snapshot = map_.snapshot()
        queries = queries_from_map(map_, snapshot, frames)
        asking = processor_milliseconds(
            lambda: run_trials(map_, encoder, snapshot, queries, encoder.calibration, lambda *_: None)
        )
        first, second = np.arange(frames), np.arange(frames, 2 * frames)
        aligning = processor_milliseconds(lambda: _shared(snapshot, "second", first, second, lambda _: None))
        atlas.close()
    parts: dict[str, Any] = {
        "a frame is decoded and encoded": encoding,
        "a place is stored (enrolment, re-encoding)": storing / (2 * frames),
        "a query of a calibration": asking / queries.count,
        "a frame is aligned": aligning / frames,
    }
    rows = [(name, spent, f"{100 * spent / (encoding + spent):.0f} %") for name, spent in parts.items()]
    rows[0] = (rows[0][0], rows[0][1], "")
    title = f"{DEFAULT_ENCODER}, two traverses of {frames} frames, {content}"
    report(
        "ray_serve_jobs", title, ["", "processor ms", "of it and encoding"], rows, {"frames": frames, "parts": parts}
    )


if __name__ == "__main__":
    typer.run(main)
