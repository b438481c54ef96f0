"""Forks a child for each run of the script off a process that has imported everything, so that a run starts at once.

``python -m tests.faults.script_forks`` reads lines of JSON, ``[directory, go, result, indexed]`` the
arguments of :func:`tests.faults.script.run`, and answers each with the child's process id.
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
    """Fork one child a line, until the input ends."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    _warm_up()
    for line in sys.stdin:
        child = os.fork()
        if not child:
            _be_child(line)
        print(child, flush=True)


def _warm_up() -> None:
    """Run the script once, so that everything is imported and compiled; leave no thread, which a child would lack."""
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
