"""A clock that jumps: ``python -m tests.faults.clock FILE command …`` runs a Python command with another wall clock.

The wall clock of the process is off by the seconds in FILE, which is read at every call.  Python's functions are
replaced for this, because the system's own clock is shared and a time namespace does not change the wall clock.  The
monotonic clock stays as it is, as it does when a system's clock is set.
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
    """The seconds by which the clock is off."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_RDONLY)  # kept open: the process may run out of file descriptors

    def seconds(self) -> float:
        """The number in the file now."""
        return float(os.pread(self._file, 32, 0) or 0)


def install(offset: Offset) -> None:
    """Replace the clock of this process; call this before anything else is imported."""

    class Kind(type):
        """Makes every ``datetime`` an instance of the class below."""

        def __instancecheck__(cls, value: object) -> bool:
            return isinstance(value, _datetime)

    class Moved(_datetime, metaclass=Kind):
        """``datetime`` with the time of the clock that is off."""

        @classmethod
        def now(cls, tz: Any = None) -> Any:
            return _datetime.now(tz) + datetimes.timedelta(seconds=offset.seconds())

        @classmethod
        def utcnow(cls) -> Any:
            return _datetime.utcnow() + datetimes.timedelta(seconds=offset.seconds())

    time.time = lambda: _time() + offset.seconds()
    datetimes.datetime = Moved  # type: ignore[misc]


def main() -> None:
    """Run the command in the arguments: FILE, the interpreter, ``-m``, a module and its arguments."""
    path, _, flag, module, *arguments = sys.argv[1:]
    assert flag == "-m"
    install(Offset(Path(path)))
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
