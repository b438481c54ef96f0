"""The C library's heaps."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

LOOK = "from service.malloc import configure_malloc; print(configure_malloc())"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="mallopt is of the GNU C library")
@pytest.mark.parametrize(("told", "settled"), [({}, "True"), ({"MALLOC_ARENA_MAX": "4"}, "False")])
def test_the_heap_is_settled_unless_the_operator_has(told: dict[str, str], settled: str) -> None:
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
    done = subprocess.run([sys.executable, "-c", LOOK], env={**plain, **told}, capture_output=True, text=True)
    assert done.stdout.strip() == settled, done.stderr


FREE = """
from benchmarks.process import memory
from service.malloc import configure_malloc, return_free_memory
import os
configure_malloc()
blocks = [bytearray(1 << 20) for _ in range(80)]
last = blocks.pop()  # holds the end of the heap, so that nothing before it goes back by itself
del blocks
before = memory(os.getpid())
return_free_memory()
print(before - memory(os.getpid()))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="malloc_trim is of the GNU C library")
def test_freed_memory_goes_back_to_the_system_when_it_is_told() -> None:
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
    done = subprocess.run([sys.executable, "-c", FREE], env=plain, capture_output=True, text=True, check=True)
    assert float(done.stdout) > 60
