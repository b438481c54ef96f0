"""Threads: those of torch, FAISS, OpenCV and NumPy share the cores, and none holds one while it waits.

One frame's forward pass is shared between the cores; all else that is done for a frame takes so little that a
second thread would cost more than it gains.  Of several frames, each core takes whole ones (:func:`each`).
"""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, MutableMapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from typing import TypeVar

from threadpoolctl import ThreadpoolController

Item = TypeVar("Item")
Made = TypeVar("Made")

SPINS = "1000"
"""Turns that an OpenMP thread waits awake for its next work before it sleeps: some ten microseconds."""


def wait_briefly(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let OpenMP's threads sleep soon after a parallel section; to be called before torch or FAISS are imported.

    By default they spin for a millisecond and more.  The search that follows a forward pass then has half the
    machine, and when other processes want the cores, threads that spin take them from those that are waited for.
    What the user has set stays.
    """
    if "OMP_WAIT_POLICY" not in environment:
        environment.setdefault("GOMP_SPINCOUNT", SPINS)


def cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


@cache
def keep_numpy_single_threaded() -> None:
    """Let NumPy's BLAS compute in the calling thread, from now on, in this process.

    Waiting for a second thread costs a small product more than it gains, and on a busy machine many
    times more: the whole takes as long as its latest thread.  torch and FAISS bring libraries of
    their own, which keep their threads.
    """
    for library in ThreadpoolController().lib_controllers:
        if library.user_api == "blas" and "numpy" in library.filepath:
            library.set_num_threads(1)


def share_cores(threads: int) -> None:
    """Let torch and FAISS use so many threads each, and OpenCV none of its own, in this process.

    Frames are encoded and maps are searched in turn, so each may have all of the cores; OpenCV would only
    split what takes it a tenth of a millisecond.

    Args:
        threads: at least 1.
    """
    import cv2
    import faiss
    import torch

    torch.set_num_threads(threads)
    faiss.omp_set_num_threads(threads)
    cv2.setNumThreads(1)
    keep_numpy_single_threaded()


def keep_to(number: int | None) -> None:
    """Let this thread run on one core of the process's, or on any of them; where the system lets us say so.

    Args:
        number: of the core, from 0 on and counted round; None: any, also where this thread was begun by one that keeps
            to a core, which it would otherwise share.
    """
    if sys.platform == "linux":
        with suppress(OSError):
            every = sorted(os.sched_getaffinity(os.getpid()))
            os.sched_setaffinity(0, every if number is None else [every[number % len(every)]])


def compute_alone(number: int | None = None) -> None:
    """Let this thread compute by itself: others have the other cores.

    Args:
        number: from 0 on, of this thread among those of which each has a core of its own from now on. Left to itself, a
            system leaves two threads on one core for milliseconds while another core is idle.
    """
    import torch

    keep_to(number)
    torch.get_num_threads()  # torch settles a thread's number at its first use, and would undo what follows
    for library in ThreadpoolController().lib_controllers:
        if library.user_api == "openmp":
            library.set_num_threads(1)  # OpenMP keeps this number by thread


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "core", compute_alone)


def in_turns(
    run: Callable[[Item], object],
    parts: Iterable[Item],
    executor: Executor | None,
    helpers: int,
) -> None:
    """Run every part once, in so many threads of the executor and in the calling one.

    Each thread takes the next part when it has done one, so that a core that is busy elsewhere delays nothing but
    the part it is at; a helper that has not begun by the end is not waited for.
    """
    waiting = deque(parts)

    def work() -> None:
        while True:
            try:
                part = waiting.popleft()
            except IndexError:
                return
            run(part)

    begun = [] if executor is None else [executor.submit(work) for _ in range(helpers)]
    work()
    for helper in begun:
        if not helper.cancel():
            helper.result()


def each(work: Callable[[Item], Made], items: Sequence[Item], threads: int) -> list[Made]:
    """``work`` of every item, in their order, each in one of so many threads that compute alone.

    It is for work that lets go of the interpreter and does not call this again.
    """
    if threads < 2 or len(items) < 2:
        return [work(item) for item in items]
    return list(_pool(threads).map(work, items))
