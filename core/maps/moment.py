"""One look at a map for a piece of work that reads it several times.

A store that asks a server for the state of a map asks once in such a piece of work: what was read since its beginning
is recent enough for all of it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_BEGAN: ContextVar[float | None] = ContextVar("began", default=None)


@contextmanager
def one_look() -> Iterator[None]:
    """Have the block read the state of a map once."""
    token = _BEGAN.set(time.monotonic())
    try:
        yield
    finally:
        _BEGAN.reset(token)


def began() -> float | None:
    """When the piece of work of this thread began, by the monotonic clock; None: there is none."""
    return _BEGAN.get()
