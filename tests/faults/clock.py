"""A clock that jumps: ``python -m tests.faults.clock FILE command …`` runs a Python command under another time.

The wall clock of the process is off by the seconds that FILE holds, looked up at every question.  That is the one seam:
the system's own clock is everybody's, and a time namespace leaves the wall clock as it is.  What counts durations, the
monotonic clock, is left alone, as it is by a clock that is set.
"""

from __future__ import annotations

import datetime as datetimes
import os
import runpy
import sys
import time
from datetime import datetime as _datetime
from pathlib import Path
from typing import Any

_time = time.time


class Offset:
    """So many seconds the clock is off."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_RDONLY)  # for good: files may run short meanwhile

    def seconds(self) -> float:
        """As the file says now."""
        return float(os.pread(self._file, 32, 0) or 0)


def install(offset: Offset) -> None:
    """Put the other clock in the place of the process's own; before anything else is imported."""

    class Kind(type):
        """Every moment is one of the moved clock's, whoever made it."""

        def __instancecheck__(cls, value: object) -> bool:
            return isinstance(value, _datetime)

    class Moved(_datetime, metaclass=Kind):
        """``datetime`` whose ``now`` is the other clock's."""

        @classmethod
        def now(cls, tz: Any = None) -> Any:
            return _datetime.now(tz) + datetimes.timedelta(seconds=offset.seconds())

        @classmethod
        def utcnow(cls) -> Any:
            return _datetime.utcnow() + datetimes.timedelta(seconds=offset.seconds())

    time.time = lambda: _time() + offset.seconds()
    datetimes.datetime = Moved  # type: ignore[misc]


def main() -> None:
    """FILE, then the words of a command that begins with the interpreter and ``-m module``."""
    path, _, flag, module, *arguments = sys.argv[1:]
    assert flag == "-m"
    install(Offset(Path(path)))
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
