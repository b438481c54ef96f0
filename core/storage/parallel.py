"""Work shared by the threads of all maps, one for each core that this process may use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Barrier
from typing import TypeVar

import faiss

from core.threads import cores, in_turns

Part = TypeVar("Part")


@cache
def threads() -> tuple[ThreadPoolExecutor, int]:
    """The threads, and how many they are."""
    count = cores()
    # Each is one core's worth of work already; FAISS is not to make threads of its own below it.
    pool = ThreadPoolExecutor(count, thread_name_prefix="search", initializer=faiss.omp_set_num_threads, initargs=(1,))
    # All of them at once and now: a thread is as nice as the one that first needed it, and cannot be made less so.
    begun = Barrier(count)
    for _ in range(count):
        pool.submit(begun.wait)
    return pool, count


def together(run: Callable[[Part], None], parts: Sequence[Part], calling_too: bool) -> None:
    """Run every part once, on as many threads as there are cores, the calling one among them or not."""
    if len(parts) == 1:
        run(parts[0])
        return
    pool, count = threads()
    in_turns(run, parts, pool, min(len(parts), count) - calling_too, calling_too)
