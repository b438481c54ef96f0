"""Forks real servers off a process that has imported everything and started no thread; run it by ``python -m``.

It prints ``ready``.  Then each line on standard input is a JSON object with ``environment``, ``log`` and ``traced``; it
is answered with the number of a process that runs ``placerec serve`` in that environment, with ``traced`` as soon as a
tracer follows it.  Such a start takes as long as opening the data directory and loading the encoder.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import signal
import sys
import time
from pathlib import Path

MODULES = (
    "torch",
    "uvicorn",
    "uvloop",
    "service.app.application",
    "service.commands.serve",
    "service.telemetry.native_output",
    "service.http.server",
)


def main() -> None:
    """Fork one server a line, until the input ends."""
    for name in MODULES:
        importlib.import_module(name)
    from service.commands import main as placerec

    gc.freeze()
    print("ready", flush=True)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for them
    for line in sys.stdin:
        wanted = json.loads(line)
        process = os.fork()
        if process == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            log = os.open(wanted["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            for stream in (1, 2):
                os.dup2(log, stream)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            while wanted["traced"] and "TracerPid:\t0\n" in Path("/proc/self/status").read_text():
                time.sleep(0.002)
            os.environ.update(wanted["environment"])
            sys.argv = ["placerec", "serve"]
            placerec()
            os._exit(0)
        print(process, flush=True)


if __name__ == "__main__":
    main()
