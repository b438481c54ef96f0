"""Turns what native libraries write to standard error into log lines.

libjpeg and libpng, for example, write "Corrupt JPEG data" there, which would appear between the lines of JSON.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

LONGEST = 500
"""Most bytes of a line; the rest is left out."""

NOISE = re.compile(r"JPEG|libpng|WebP|\[ *WARN:.*grfmt_")
"""Messages about damaged frames, which are reported to their callers and so of no use to an operator."""

log = logging.getLogger("placerec.native")


@contextmanager
def logged_stderr() -> Iterator[None]:
    """Lead file descriptor 2 into the log, and ``sys.stderr`` to where descriptor 2 led before.

    Configure logging within this context: a handler with the old ``sys.stderr`` would be logged in turn.  A crash of
    the interpreter is still reported on the old descriptor.
    """
    before = sys.stderr
    before.flush()
    original = os.dup(2)
    reading, writing = os.pipe()
    # If the pipe is full, a library loses its line instead of waiting for a thread that may wait for it.
    os.set_blocking(writing, False)
    os.dup2(writing, 2)
    os.close(writing)
    own = os.fdopen(os.dup(original), "w", buffering=1, encoding="utf-8", errors="backslashreplace")
    sys.stderr = own
    faulthandler.enable(own)
    thread = threading.Thread(target=_log_lines, args=(reading,), name="native-log", daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.dup2(original, 2)  # this closes the last writing end of the pipe
        thread.join(1.0)
        faulthandler.enable(original)
        sys.stderr = before
        # Both descriptors stay open: a log handler may still use one, and the crash handler the other.


def _log_lines(reading: int) -> None:
    with os.fdopen(reading, "rb", buffering=0) as pipe:
        line, cut = b"", False
        while chunk := pipe.read(4096):
            *whole, rest = chunk.split(b"\n")
            for part in whole:
                _log_line(line + part if not cut else line)
                line, cut = b"", False
            line, cut = (line + rest)[:LONGEST], cut or len(line) + len(rest) > LONGEST
        _log_line(line)


def _log_line(line: bytes) -> None:
    text = line[:LONGEST].decode("utf-8", "backslashreplace").strip()
    if text:
        log.log(logging.DEBUG if NOISE.search(text) else logging.WARNING, "%s", text)
