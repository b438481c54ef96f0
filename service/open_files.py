"""The files that the process may have open, and how connections and maps share them.

Each connection and each map that is open holds descriptors, of which the system allows so many.  Both are bounded, so
that one is free whenever somebody connects, however many maps have been used.
"""

from __future__ import annotations

import logging
import os
import resource
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from service.settings import PREFIX, Settings

FILES_OF_A_MAP = 5
"""Descriptors of an open map: of its database, of the log and the shared memory of that, to write and to read."""

BYTES_OF_A_MAP = 700_000
"""Memory of an open map, besides what it holds for searching."""

MOST_MAPS = 256
"""Maps that are open where the setting names no number; with a place each they take 180 MB."""

RESERVE = 160
"""The fewest descriptors that neither connections nor maps get: some 30 are those of an idle service, 64 those of
connections that are refused with an answer, the others those of new connections and of what is open for a moment."""

CGROUP = Path("/sys/fs/cgroup/memory.max")
"""The memory of the container in which this process runs, where Linux shows it one (cgroup 2)."""

log = logging.getLogger("placerec.open_files")


class Shares(NamedTuple):
    """What may be open at the same time."""

    connections: int
    maps: int


def shares(files: int, memory: int, connections: int, maps: int | None) -> Shares:
    """Share the descriptors of a process.

    A quarter of them, at least ``RESERVE``, is nobody's.  Of the others connections get as many as are wanted, at most
    half, and maps the rest.

    Args:
        files: descriptors that the process may have.
        memory: bytes that it may use.
        connections: as many as are wanted.
        maps: as many as are wanted; None: those that fit into a 64th of the memory, at most ``MOST_MAPS``.
    """
    reserve = max(RESERVE, files // 4)
    connections = max(1, min(connections, (files - reserve) // 2))
    wanted = min(memory // 64 // BYTES_OF_A_MAP, MOST_MAPS) if maps is None else maps
    maps = max(1, min(wanted, (files - reserve - connections) // FILES_OF_A_MAP))
    return Shares(connections, maps)


def shares_of(settings: Settings) -> Shares:
    """What this process may have open at the same time."""
    return shares(most_open_files(), memory(), settings.max_connections, settings.open_maps)


def most_open_maps(settings: Settings) -> int:
    """The number of maps that this process may have open at the same time."""
    return shares_of(settings).maps


def raise_limit(settings: Settings) -> None:
    """Have the system allow as many open files as this process may request; warn if settings want more."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and soft != hard:
        with suppress(OSError):  # the system may have been told since to allow fewer
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    found = shares_of(settings)
    if found.connections < settings.max_connections or found.maps < (settings.open_maps or 1):
        log.warning(
            "the system allows %d open files: at most %d connections and %d maps are open, whatever %sMAX_CONNECTIONS "
            "and %sOPEN_MAPS are",
            *(most_open_files(), found.connections, found.maps, PREFIX, PREFIX),
        )


def most_open_files() -> int:
    """The number of descriptors that this process may have."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return 1 << 20 if soft == resource.RLIM_INFINITY else soft


def open_files() -> int | None:
    """The number of descriptors that this process has; None where the system does not report it."""
    with suppress(OSError):
        return len(os.listdir("/proc/self/fd")) - 1  # one is of the listing
    return None


def memory(cgroup: Path = CGROUP) -> int:
    """The bytes of memory that this process may use: those of its container, or of the machine."""
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    with suppress(OSError, ValueError):  # there is no such file, or it has "max"
        return min(machine, int(cgroup.read_text()))
    return machine
