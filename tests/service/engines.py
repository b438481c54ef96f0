"""The runtime without HTTP and without its event loop, for jobs that encode nothing on maps of random descriptors."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from core.maps import Enrolment
from core.places import PlaceFields, Pose
from service.app.runtime import Runtime
from service.engine.engine import Engine
from service.jobs.job import Job
from service.settings import Settings
from service.telemetry.metrics import Metrics
from tests.core.store.frames import keypoints_of

ENCODER = "some@" + "0" * 64


@contextmanager
def runtime_at(folder: Path, **settings: Any) -> Iterator[Runtime]:
    """A runtime whose event loop does not run."""
    runtime = Runtime(Settings(data_dir=folder / "data", **settings), Metrics())
    runtime.jobs.start()
    try:
        yield runtime
    finally:
        runtime.jobs.close(10)
        runtime.statistics.close()
        runtime.sessions.close()
        runtime.engine.close()


def enrolments(first: int, count: int, name: str, sequence: str, dimension: int = 8) -> list[Enrolment]:
    """Places with random descriptors, numbered from ``first`` on."""
    random = np.random.default_rng(first)
    made = []
    for number in range(first, first + count):
        picture = f"picture {number}".encode()
        fields = PlaceFields(pose=Pose(x=number, y=0), sequence=sequence, metadata={"number": number})
        descriptor = random.normal(size=dimension).astype(np.float32)
        digest = number.to_bytes(32, "big")
        keypoints = keypoints_of(f"picture {number}")
        made.append(Enrolment(f"{name}{number}", fields, descriptor, 5, digest, thumbnail=picture, keypoints=keypoints))
    return made


def state_of(engine: Engine, map_id: str) -> list[tuple[Any, ...]]:
    """Everything that a map stores: places, their order, pictures, keypoints and descriptors."""
    map_ = engine.maps.get(map_id)
    outline, snapshot = map_.transfer.outline(), map_.snapshot()
    rows = np.array([place.row for place in outline], np.int64)
    descriptors, keypoints = snapshot.descriptors_at(rows), map_.keypoints_at(rows.tolist())
    return [
        (map_.place(place.id), place.ordinal, map_.picture(place.id), found and found.record(), descriptor.tobytes())
        for place, found, descriptor in zip(outline, keypoints, descriptors, strict=True)
    ]


def end_of(runtime: Runtime, job: Job) -> Job:
    until = time.monotonic() + 60
    while not (found := runtime.jobs.get(job.id)).ended:
        assert time.monotonic() < until, found
        time.sleep(0.01)
    return found
