"""What a map that is searched by codes leaves behind in the process: memory that is free, threads that are not slow."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import pytest

from core.maps import MapSettings
from core.store import Directory, Map
from core.store.snapshot import threads
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame

REPOSITORY = Path(__file__).parents[4]


def become(lab: Map, tier: str) -> None:
    lab.edit({"index": tier})
    deadline = time.monotonic() + 60
    while (status := lab.index_status()).state == "building" or status.tier != tier:
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.mark.parametrize("local_shape", [LOCAL_SHAPE, (0, 0)])
def test_descriptors_read_at_the_start_are_given_up(directory: Path, local_shape: tuple[int, int]) -> None:
    atlas = Directory(directory, rows_per_segment=4)
    made = atlas.create("lab", ENCODER, DIMENSION, MapSettings(), local_shape)
    made.enrol([frame(f"p{i}", local_shape=local_shape) for i in range(10)])
    atlas.close()
    atlas = Directory(directory)
    lab = atlas.get("lab")
    held = [weakref.ref(segment.held) for segment in lab.snapshot().segments]
    assert all(ref() is not None for ref in held)
    become(lab, "compact")
    gc.collect()
    assert [ref() for ref in held] == [None] * 3
    become(lab, "exact")
    assert all(segment.held is not None for segment in lab.snapshot().segments)
    assert lab.verify().ok
    atlas.close()


def priorities(directory: Path) -> None:
    """Print those of the threads that search, which a map that was built is the first to need, and the process's."""
    atlas = Directory(directory)
    lab = atlas.create("lab", ENCODER, DIMENSION, MapSettings(), LOCAL_SHAPE)
    lab.enrol([frame(f"p{i}") for i in range(200)])
    become(lab, "compact")
    pool, count = threads()
    all_there = threading.Barrier(count)

    def priority() -> int:
        all_there.wait(60)
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    print({task.result() for task in [pool.submit(priority) for _ in range(count)]}, os.getpriority(os.PRIO_PROCESS, 0))
    atlas.close()


@pytest.mark.thorough
def test_the_threads_that_search_are_not_as_nice_as_the_one_that_builds(directory: Path) -> None:
    command = [sys.executable, "-m", "tests.core.storage.search.test_tier_memory", str(directory)]
    finished = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=300, check=True)
    searching, of_process = finished.stdout.strip().rsplit(" ", 1)
    assert searching == f"{{{of_process}}}"


if __name__ == "__main__":
    priorities(Path(sys.argv[1]))
