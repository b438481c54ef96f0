"""A process that has everything imported and forks one child for each script, so that a fault costs no start.

``python -m tests.faults.nursery`` reads lines of JSON, ``[directory, go, result, indexed]`` with what
:func:`tests.faults.script.run` is to be given, and answers each with the child's process id.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import tempfile
from pathlib import Path

import faiss

from core.storage.search import snapshot
from tests.faults import script

_SET_TRACER, _ANY = 0x59616D61, ctypes.c_ulong(-1)


def main() -> None:
    """Until standard input ends."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    _warm_up()
    for line in sys.stdin:
        child = os.fork()
        if not child:
            _be_child(line)
        print(child, flush=True)


def _warm_up() -> None:
    """Do the script once, so that all is imported and compiled; no thread that a child would miss is left."""
    faiss.omp_set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        for name in ("go", "passed"):
            (Path(folder) / name).touch()
        script.run(Path(folder) / "data", Path(folder) / "go", Path(folder) / "result", False)
    snapshot.threads.cache_clear()


def _be_child(line: str) -> None:
    ctypes.CDLL(None).prctl(_SET_TRACER, _ANY, 0, 0, 0)  # where only parents may trace otherwise
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    directory, go, result, indexed = json.loads(line)
    try:
        script.run(Path(directory), Path(go), Path(result), indexed)
    finally:
        os._exit(0)


if __name__ == "__main__":
    main()
