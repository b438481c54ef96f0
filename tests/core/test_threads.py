"""How threads wait, and work shared between those that compute alone."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from threadpoolctl import ThreadpoolController

from core import threads as sharing
from core.networks.torch_network import follow_threads
from core.threads import (
    SPINS,
    allowed_threads,
    begun,
    compute_alone,
    cores,
    each,
    keep_to,
    processors,
    share_cores,
    use_threads,
    wait_briefly,
)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ({}, {"GOMP_SPINCOUNT": SPINS}),
        ({"GOMP_SPINCOUNT": "5"}, {"GOMP_SPINCOUNT": "5"}),
        ({"OMP_WAIT_POLICY": "active"}, {"OMP_WAIT_POLICY": "active"}),
    ],
)
def test_what_the_user_has_set_stays(before: dict[str, str], after: dict[str, str]) -> None:
    wait_briefly(before)
    assert before == after


@pytest.mark.thorough
@pytest.mark.parametrize(
    "module",
    [
        "service.engine.queue",
        *(
            pytest.param(module, marks=pytest.mark.thorough)
            for module in ("core.method.catalogue", "benchmarks.encode", "service.commands")
        ),
    ],
)
def test_it_is_set_before_torch_is_imported(module: str) -> None:
    code = f"import os, sys, importlib.abc\n{WATCH}\nimport {module}\nassert os.environ['GOMP_SPINCOUNT'] == '{SPINS}'"
    clean = {"PATH": "/usr/bin:/bin"}
    done = subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


WATCH = """
class Watch(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        assert name not in ("torch", "faiss") or "GOMP_SPINCOUNT" in os.environ, name + " is imported too early"
sys.meta_path.insert(0, Watch())
"""


def test_results_stand_in_the_order_of_the_items_and_errors_are_raised() -> None:
    def slow_at_first(item: int) -> int:
        time.sleep(0.02 / (item + 1))
        return item * item

    assert each(slow_at_first, range(8), 4) == [n * n for n in range(8)]
    assert each(slow_at_first, [], 4) == []
    with pytest.raises(ZeroDivisionError):
        each(lambda n: 1 // n, [1, 0, 2], 2)


def test_several_threads_work_each_alone_and_the_caller_keeps_its_own() -> None:
    before = allowed_threads()
    together = threading.Barrier(2, timeout=60)

    def work(_: int) -> tuple[str, int]:
        together.wait()  # only if two run at one time
        return threading.current_thread().name, allowed_threads()

    found = each(work, [0, 1], 2)
    assert len({name for name, _ in found}) == 2
    assert [threads for _, threads in found] == [1, 1]
    assert allowed_threads() == before
    assert each(lambda _: threading.current_thread(), [0, 1], 1) == [threading.current_thread()] * 2


def test_begun_work_is_done_once_beside_the_caller_or_when_it_is_wanted() -> None:
    done: list[str] = []

    def work() -> int:
        done.append(threading.current_thread().name)
        return len(done)

    before = allowed_threads()
    try:
        use_threads(2)
        wait = begun(work)
        assert wait() == wait() == 1 and done[0] != threading.current_thread().name
        with pytest.raises(ZeroDivisionError):
            begun(lambda: 1 // 0)()
        use_threads(1)
        wait = begun(work)
        assert len(done) == 1, "nobody has asked for it"
        assert wait() == wait() == 2 and done[1] == threading.current_thread().name
    finally:
        use_threads(before)


def test_work_that_the_end_of_a_process_meets_is_done_all_the_same() -> None:
    """Threads begin nothing any more once the interpreter ends, as while a service that is stopped still rehearses."""
    code = (
        "import atexit\nfrom core.threads import begun, each, use_threads\nuse_threads(2)\n"
        "atexit.register(lambda: print(each(lambda n: n * n, [1, 2, 3], 2), begun(lambda: 7)()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "[1, 4, 9] 7\n", "")


@pytest.mark.parametrize(
    ("said", "wanted"),
    [("50000 100000", 1), ("100000 100000", 1), ("110000 100000", 2), ("99900000 100000", None), ("max 100000", None)],
)
def test_a_containers_quota_bounds_the_cores(
    said: str, wanted: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cpu.max").write_text(f"{said}\n")
    monkeypatch.setattr(sharing, "CGROUP", tmp_path / "cpu.max")
    assert cores() == min(wanted or processors(), processors())
    monkeypatch.setattr(sharing, "CGROUP", tmp_path / "missing")
    assert cores() == processors()


def test_torch_and_faiss_follow_the_thread_that_they_compute_in() -> None:
    def found() -> list[int]:
        use_threads(3)
        follow_threads()
        openmp = [library for library in ThreadpoolController().info() if library["user_api"] == "openmp"]
        return [allowed_threads(), torch.get_num_threads(), *(library["num_threads"] for library in openmp)]

    before = torch.get_num_threads()
    try:
        with ThreadPoolExecutor(1) as pool:
            told = pool.submit(found).result()
        assert len(told) >= 3 and set(told) == {3}
    finally:
        torch.set_num_threads(before)


def test_threads_are_shared_out() -> None:
    before = allowed_threads()
    try:
        share_cores(1)
        assert allowed_threads() == 1
        blas = [library for library in ThreadpoolController().lib_controllers if "numpy" in library.filepath]
        assert blas and all(library.num_threads == 1 for library in blas if library.user_api == "blas")
        np.testing.assert_allclose(np.ones((3, 3)) @ np.ones((3, 3)), 3)
    finally:
        share_cores(before)
    assert 1 <= cores() <= 4096


@pytest.mark.skipif(sys.platform != "linux", reason="others do not let a thread keep to a core")
def test_a_thread_keeps_to_its_core_and_what_it_begins_does_not() -> None:
    every = sorted(os.sched_getaffinity(0))

    def begins(number: int | None) -> tuple[set[int], int, set[int], int]:
        with ThreadPoolExecutor(1, initializer=keep_to, initargs=(number,)) as outer:
            own = outer.submit(lambda: (os.sched_getaffinity(0), cores())).result()

            def begin() -> tuple[set[int], int]:
                with ThreadPoolExecutor(1, initializer=compute_alone) as inner:
                    return inner.submit(lambda: (os.sched_getaffinity(0), allowed_threads())).result()

            return *own, *outer.submit(begin).result()

    for number in range(len(every) + 1):
        assert begins(number) == ({every[number % len(every)]}, len(every), set(every), 1)
    assert begins(None) == (set(every), len(every), set(every), 1)
    assert os.sched_getaffinity(0) == set(every)
