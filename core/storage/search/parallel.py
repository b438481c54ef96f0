"""Work shared by the threads of all maps, one for each core that this process may use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Barrier
from typing import TypeVar

from core.threads import cores, in_turns, keep_to

Part = TypeVar("Part")


@cache
def threads() -> tuple[ThreadPoolExecutor, int]:
    """The threads, and how many they are."""
    count = cores()
    pool = ThreadPoolExecutor(count, "search", keep_to, (None,))
    # All of them at once and now: a thread is as nice as the one that first needed it, and cannot be made less so.
    begun = Barrier(count)
    for _ in range(count):
        pool.submit(begun.wait)
    return pool, count


def together(run: Callable[[Part], None], parts: Sequence[Part], share: int = 1) -> None:
    """Run every part once, on one thread for each ``share`` cores, the calling one among them."""
    helpers = min(len(parts), cores() // share) - 1
    in_turns(run, parts, threads()[0] if helpers > 0 else None, helpers)
