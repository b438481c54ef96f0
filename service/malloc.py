"""How glibc's malloc keeps freed memory.

By default each thread has an arena of its own, and each arena keeps what its largest picture needed: after some ten
thousand damaged pictures of all sizes the process holds a quarter more memory than it needs.  Here the arenas are few,
so that a service stays as small as it was at first, and they keep enough that a frame does not wait for pages which the
frame before has just returned to the system.
"""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress

MIB = 1 << 20

# The options of mallopt in <malloc.h>; they are part of the library's ABI.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8

OPTIONS = {
    _ARENA_MAX: 2,  # one for each core of a small machine; threads that share one wait for microseconds
    _MMAP_THRESHOLD: 16 * MIB,  # larger blocks (pictures of over five megapixels) return to the system at once
    _TRIM_THRESHOLD: 32 * MIB,  # how much may stay free at the end of an arena
}


def configure_malloc() -> bool:
    """Set the options of malloc; call it before there are threads.

    Returns:
        Whether they were set: not with another C library than glibc, and not if the environment sets options itself
        (``MALLOC_…``, ``GLIBC_TUNABLES``).
    """
    chosen = [name for name in os.environ if name.startswith("MALLOC_") or name == "GLIBC_TUNABLES"]
    if chosen or not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    done = [mallopt(name, value) == 1 for name, value in OPTIONS.items()]  # all of them, even if one fails
    return all(done)


def return_free_memory() -> None:
    """Return the pages of all freed blocks to the system; of another C library than glibc, nothing is asked."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
