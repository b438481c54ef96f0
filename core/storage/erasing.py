"""Erasing what deleted places have left in the files of a map, so that no search of the bytes finds it.

Rows of segment files are never moved, so the descriptors of rows without a place are overwritten where they are.  A
snapshot, an export or a check that began before may still read them; the work begins when none does any more.
"""

from __future__ import annotations

import gc
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.errors import MapBusy
from core.index.flat import vectors
from core.storage.files import segment_files
from core.storage.files.segment_files import Layout
from core.storage.search.segment import Reading
from core.storage.search.snapshot import Snapshot

PATIENCE_SECONDS = 60.0
_LOOK_SECONDS = 0.05


@dataclass(frozen=True, eq=False)
class DeadRows:
    """The rows of a map without a place at one moment, and who may still read them.

    offsets: int64 [n] of each segment that has such rows, by its number.
    """

    offsets: Mapping[int, NDArray[np.int64]]
    readings: tuple[weakref.ref[Reading], ...]

    def __len__(self) -> int:
        return sum(len(of_segment) for of_segment in self.offsets.values())

    @property
    def are_read(self) -> bool:
        """Whether an older snapshot is still in use."""
        return any(reading() is not None for reading in self.readings)


def dead_rows(newest: Snapshot, former: DeadRows | None) -> tuple[DeadRows, Snapshot]:
    """The rows without a place, and the snapshot to publish, which none of those that are in use is.

    Snapshots that are made of that one cannot read the rows.

    Args:
        former: those of the last time, for which somebody may have waited in vain.
    """
    offsets = {
        number: np.flatnonzero(~segment.alive)
        for number, segment in enumerate(newest.segments)
        if not segment.removed and segment.living < len(segment)
    }
    readings = tuple(weakref.ref(newest.segments[number].unerased) for number in offsets)
    if former is not None:
        readings += tuple(reading for reading in former.readings if reading() is not None)
    segments = list(newest.segments)
    for number in offsets:
        segments[number] = replace(segments[number], unerased=Reading())
    return DeadRows(offsets, readings), replace(newest, segments=tuple(segments))


def wait_until(free: Callable[[], bool], look: Callable[[], None]) -> None:
    """Wait until something is so.

    Args:
        look: is called meanwhile; its exceptions end the waiting.

    Raises:
        MapBusy: it is not so after a minute.
    """
    end = time.monotonic() + PATIENCE_SECONDS
    while not free():
        gc.collect()  # a snapshot in a circle of objects, as a traceback makes it, is in use by nobody
        if free():
            return
        look()
        if time.monotonic() > end:
            raise MapBusy("What was deleted is still being read, by an export, a check or a search: erase it later.")
        threading.Event().wait(_LOOK_SECONDS)


def erase_rows(folder: Path, layout: Layout, newest: Snapshot, number: int, offsets: NDArray[np.int64]) -> int:
    """Overwrite rows of a segment without a place, on disk and in memory; returns how many were not before.

    Raises:
        Damage, OSError.
    """
    segment = newest.segments[number]
    if segment.removed:
        return 0
    count = segment_files.erase(folder, layout, number, offsets.tolist())
    if segment.held is not None:
        blank = np.zeros(1, layout.record)
        vectors(segment.index)[offsets] = layout.descriptors_of(blank)[0]
        segment.local[offsets] = layout.locals_of(blank)[0]
    return count
