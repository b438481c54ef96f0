"""Work shared by the threads of all maps, one for each core that this process may use."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Barrier
from typing import TypeVar

import faiss

Part = TypeVar("Part")


@cache
def threads() -> tuple[ThreadPoolExecutor, int]:
    """The threads, and how many they are."""
    count = len(os.sched_getaffinity(0))
    # Each is one core's worth of work already; FAISS is not to make threads of its own below it.
    pool = ThreadPoolExecutor(count, thread_name_prefix="search", initializer=faiss.omp_set_num_threads, initargs=(1,))
    # All of them at once and now: a thread is as nice as the one that first needed it, and cannot be made less so.
    begun = Barrier(count)
    for _ in range(count):
        pool.submit(begun.wait)
    return pool, count


def together(run: Callable[[Part], None], parts: Sequence[Part], calling_too: bool) -> None:
    """Run every part once, on as many threads as there are cores.

    Each thread takes the next part when it has done one, so that a core that is busy elsewhere
    delays nothing but the part it is at; a helper that has not begun by the end is not waited for.
    """
    if len(parts) == 1:
        run(parts[0])
        return
    pool, cores = threads()
    waiting = deque(parts)

    def work() -> None:
        while True:
            try:
                part = waiting.popleft()
            except IndexError:
                return
            run(part)

    helpers = [pool.submit(work) for _ in range(min(len(parts), cores) - calling_too)]
    if calling_too:
        work()
    for helper in helpers:
        if not (calling_too and helper.cancel()):
            helper.result()
