"""How the C library keeps memory that was given back: so that a service which has seen everything stays as small as
one that has seen little, and no frame waits for pages that the frame before has just given to the system.

By default each thread gets a heap of its own, and each heap keeps what its largest picture took: after some ten
thousand damaged pictures of all sizes the process holds a quarter more than it needs.
"""

from __future__ import annotations

import ctypes
import os
import sys

MIB = 1 << 20

# Of <malloc.h>, which says that they stay what they are.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8

CHOSEN = {
    _ARENA_MAX: 2,  # one for each core of a small machine; threads that meet in it wait for microseconds
    _MMAP_THRESHOLD: 16 * MIB,  # larger pieces, pictures of over five megapixels, go back to the system at once
    _TRIM_THRESHOLD: 32 * MIB,  # so much may lie free at the end of a heap
}


def settle_heap() -> bool:
    """Set how memory is kept, before there are threads; whether that was done.

    It is not where the C library is another than GNU's, or where the environment says something else already
    (``MALLOC_…``, ``GLIBC_TUNABLES``).
    """
    told = [name for name in os.environ if name.startswith("MALLOC_") or name == "GLIBC_TUNABLES"]
    if told or not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    done = [mallopt(name, value) == 1 for name, value in CHOSEN.items()]
    return all(done)
