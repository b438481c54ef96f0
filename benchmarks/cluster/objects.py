"""The cost of an object store: places enrolled, pictures read, and the 30 frames of a query, with it and without.

    python -m benchmarks.cluster.objects [--places 320] [--bytes 8000]

It needs .venv-cluster; the object store is SeaweedFS, all on this machine.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import typer

from core.maps import MapSettings
from core.milvus import open_store
from core.milvus.map import MilvusMap
from core.postgres import rows
from core.postgres.pictures.objects import Objects
from core.postgres.pictures.stored import new_object
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame
from tests.servers.milvus import running_servers

OF_A_QUERY = 30
"""Frames whose local descriptors a query reads."""


def milliseconds(work: Callable[[], object], rounds: int) -> float:
    """In the middle."""
    times = []
    for _ in range(rounds):
        began = time.perf_counter()
        work()
        times.append(1000 * (time.perf_counter() - began))
    return statistics.median(times)


def enrolled(lab: MilvusMap, name: str, batch: int, count: int, size: int) -> float:
    """Milliseconds for each place."""
    random = np.random.default_rng(0)
    batches = [
        [replace(frame(f"{name}{start + at}"), image=random.bytes(size)) for at in range(batch)]
        for start in range(0, count, batch)
    ]
    waiting = iter(batches)
    return milliseconds(lambda: lab.enrol(next(waiting)), len(batches)) / batch


def main(places: int = 320, bytes_: int = typer.Option(8000, "--bytes")) -> None:
    """Measure both in one process."""
    with running_servers() as servers:
        for title, bucket in (("PostgreSQL", None), ("object store", servers.bucket)):
            store = open_store(servers.milvus_address, servers.postgres_address, bucket=bucket)
            lab = store.create(f"lab-{len(title)}", ENCODER, DIMENSION, MapSettings(keep="image"), LOCAL_SHAPE)
            one, many = (enrolled(lab, f"of{batch}-", batch, places, bytes_) for batch in (1, 16))
            names = iter([f"of1-{number}" for number in range(places)])
            read = milliseconds(lambda lab=lab, names=names: lab.picture(next(names)), places)  # type: ignore[misc]
            print(f"{title}: enrolment {one:.1f} ms a place alone, {many:.1f} in 16; a picture {read:.1f} ms")
            if bucket is None:

                def frames(lab: MilvusMap = lab) -> None:
                    with lab.viewing() as (connection, _):
                        rows.locals_at(connection, range(OF_A_QUERY))

                print(f"{OF_A_QUERY} frames from PostgreSQL: {milliseconds(frames, 50):.1f} ms")
            else:
                objects, content = Objects(bucket), os.urandom(bytes_)
                stored = [new_object("trial", number, content) for number in range(OF_A_QUERY)]
                objects.put({one.name: content for one in stored})
                print(f"{OF_A_QUERY} objects: {milliseconds(partial(objects.read, stored), 50):.1f} ms")
                objects.close()
            store.close()


if __name__ == "__main__":
    typer.run(main)
