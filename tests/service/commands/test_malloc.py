"""The C library's heaps."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

LOOK = "from service.commands.malloc import configure_malloc; print(configure_malloc())"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="mallopt is of the GNU C library")
@pytest.mark.parametrize(("told", "settled"), [({}, "True"), ({"MALLOC_ARENA_MAX": "4"}, "False")])
def test_the_heap_is_settled_unless_the_operator_has(told: dict[str, str], settled: str) -> None:
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
    done = subprocess.run([sys.executable, "-c", LOOK], env={**plain, **told}, capture_output=True, text=True)
    assert done.stdout.strip() == settled, done.stderr
