"""How the threads of ONNX Runtime, torch, FAISS, OpenCV and NumPy share the cores.

The forward pass of a single frame uses all cores; everything else that is done for a frame takes so little time that
a second thread would cost more than it saves.  Of several frames, each core takes whole ones (:func:`each`).
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, MutableMapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from math import ceil
from pathlib import Path
from typing import Any, TypeVar

from threadpoolctl import LibController, ThreadpoolController

Item = TypeVar("Item")
Made = TypeVar("Made")

CGROUP = Path("/sys/fs/cgroup/cpu.max")
"""The quota of the container in which this process runs, where Linux shows it one (cgroup 2)."""

SPINS = "1000"
"""How often an idle OpenMP thread polls for work before it sleeps: about ten microseconds."""


_shared = 0
"""Threads that a thread may use which was told nothing; 0: one for each core."""

_own = threading.local()


def allowed_threads() -> int:
    """With how many threads, itself among them, the calling thread may compute: what it was told, or what is shared."""
    told: int | None = getattr(_own, "threads", None)
    return told or _shared or cores()


def wait_briefly(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let OpenMP's threads sleep soon after a parallel section; call this before torch or FAISS is imported.

    By default they spin for a millisecond and more, and take cores from what follows and from other processes.  An
    ``OMP_WAIT_POLICY`` or ``GOMP_SPINCOUNT`` that the user has set stays.
    """
    if "OMP_WAIT_POLICY" not in environment:
        environment.setdefault("GOMP_SPINCOUNT", SPINS)


def cores() -> int:
    """How many cores' time this process may use: of its processors, and of its container's quota, rounded up."""
    return max(1, min(processors(), ceil(_quota(CGROUP))))


def processors() -> int:
    """On how many processors this process may run."""
    return len(os.sched_getaffinity(os.getpid())) if sys.platform == "linux" else os.cpu_count() or 1


@cache
def _quota(file: Path) -> float:
    """The cores' time that a control group allows, by its ``cpu.max``, as "150000 100000"; or more than there are."""
    try:
        allowed, period = file.read_text().split()
        return int(allowed) / int(period)
    except (OSError, ValueError, ZeroDivisionError):  # no such file, or "max"
        return float(sys.maxsize)


@cache
def keep_numpy_single_threaded() -> None:
    """Let NumPy's BLAS compute in the calling thread from now on, in this process.

    A second thread costs a small product more time than it saves, and on a busy machine many times more, since the
    product takes as long as its slowest thread.  torch and FAISS have BLAS libraries of their own, which keep their
    threads.
    """
    for library in ThreadpoolController().lib_controllers:
        if library.user_api == "blas" and "numpy" in library.filepath:
            library.set_num_threads(1)


def share_cores(threads: int) -> None:
    """Let ONNX Runtime, torch and FAISS use this many threads each, and OpenCV one, in this process.

    Encoding and searching take turns, so each may use all of the cores.  OpenCV would only divide work that takes a
    tenth of a millisecond.

    Args:
        threads: at least 1.
    """
    import cv2
    import faiss

    global _shared
    _shared, _own.threads = threads, None
    faiss.omp_set_num_threads(threads)
    if (torch := _torch()) is not None:
        torch.set_num_threads(threads)
    cv2.setNumThreads(1)
    keep_numpy_single_threaded()


def keep_to(number: int | None) -> None:
    """Let this thread run on one of the process's cores, or on any of them; only Linux offers this.

    Args:
        number: of the core, from 0, modulo the number of cores, if each of several threads is to have one of its own:
            the system may leave two threads on one core for milliseconds while another is idle.  None: any core, even
            if this thread was started by one that is bound to a core, which it would otherwise share.
    """
    if sys.platform == "linux":
        with suppress(OSError):
            every = sorted(os.sched_getaffinity(os.getpid()))
            os.sched_setaffinity(0, every if number is None else [every[number % len(every)]])


def _torch() -> Any:
    """torch, if something has loaded it."""
    found = sys.modules.get("torch")
    return found if hasattr(found, "set_num_threads") else None  # another thread may be loading it


@cache
def _openmp(with_torch: bool) -> list[LibController]:
    """The OpenMP libraries of FAISS, and of torch if it is loaded."""
    import faiss

    faiss.omp_get_max_threads()
    return [library for library in ThreadpoolController().lib_controllers if library.user_api == "openmp"]


def use_threads(threads: int) -> None:
    """Set the number of threads, itself among them, that this thread computes with from now on; others keep theirs."""
    _own.threads = threads
    if (torch := _torch()) is not None:
        torch.get_num_threads()  # torch sets a thread's number at its first use, which would undo the following
    for library in _openmp(torch is not None):
        library.set_num_threads(threads)  # OpenMP keeps this number for each thread


def compute_alone() -> None:
    """Let this thread compute on any core, without the help of others."""
    keep_to(None)
    use_threads(1)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "core", compute_alone)


def in_turns(
    run: Callable[[Item], object],
    parts: Iterable[Item],
    executor: Executor | None,
    helpers: int,
) -> None:
    """Run every part once, in the calling thread and in ``helpers`` threads of the executor.

    A thread that has finished a part takes the next one, so that a core that is busy elsewhere delays only one part.
    A helper that has not started when all parts are taken is not waited for.
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
    """Apply ``work`` to every item, in ``threads`` threads that compute alone; the results are in the items' order.

    The work should release the interpreter lock, and must not call this function itself.
    """
    waiting = None if threads < 2 or len(items) < 2 else _in_pool(work, items, threads)
    return [work(item) for item in items] if waiting is None else [one.result() for one in waiting]


def _in_pool(work: Callable[[Item], Made], items: Sequence[Item], threads: int) -> list[Future[Made]] | None:
    """Begin ``work`` with every item; None once the process ends, when no thread begins anything any more."""
    pool = _pool(threads)
    try:
        return [pool.submit(work, item) for item in items]
    except RuntimeError:  # what the work itself raises is in the futures
        return None


def begun(work: Callable[[], Made]) -> Callable[[], Made]:
    """Begin some work in another thread that computes alone, if the calling thread may use one; what is returned waits
    for the result.  Otherwise the work is done when the result is first wanted.

    The work should release the interpreter lock, and must not call :func:`each`.
    """
    threads = allowed_threads()
    waiting = None if threads < 2 else _in_pool(lambda _: work(), [None], threads)
    return cache(work) if waiting is None else waiting[0].result
