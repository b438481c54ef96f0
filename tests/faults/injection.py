"""Fault injection by strace: lists the system calls that a process makes in a folder, and lets some of them fail."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from tests.syscalls import strace

REPOSITORY = Path(__file__).parents[2]

WRITE_CALLS = (
    "openat", "write", "pwrite64", "fsync", "fdatasync", "ftruncate", "fallocate", "mkdir", "rename", "unlink", "rmdir",
    "mmap",
)  # fmt: skip
"""The calls by which the storage layer and its SQLite write; each instance is a write point."""


@dataclass(frozen=True)
class Point:
    """The ``number``-th call of this name that the main thread makes, counted from 1."""

    call: str
    number: int
    text: str = ""


@contextmanager
def attached(process: int, arguments: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
    """Run strace on a process and all its threads until the end of the context, or of the process."""
    command = [strace() or "strace", "-f", *arguments, "-p", str(process)]
    tracer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        assert tracer.stderr is not None
        first = tracer.stderr.readline()
        assert "attached" in first, first
        yield tracer
    finally:
        tracer.terminate()
        tracer.communicate(timeout=60)


class ScriptProcesses:
    """Starts processes that run the script (:mod:`tests.faults.script`), each with faults of its own."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "tests.faults.script_forks"]
        self._process = subprocess.Popen(
            command, cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> ScriptProcesses:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(60)

    def run(self, folder: Path, arguments: Sequence[str]) -> dict[str, Any]:
        """Run the script with its data in ``folder / "data"``; its report (:func:`tests.faults.script.run`)."""
        folder.mkdir(parents=True, exist_ok=True)
        go, result = folder / "go", folder / "result"
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps([str(folder / "data"), str(go), str(result)]) + "\n")
        self._process.stdin.flush()
        child = int(self._process.stdout.readline())
        with attached(child, arguments):
            go.touch()
            _wait_for(folder / "passing", child)
        (folder / "passed").touch()
        _wait_for(result, child)
        told: dict[str, Any] = json.loads(result.read_text().splitlines()[-1])
        return told


def _wait_for(path: Path, process: int) -> None:
    until = time.monotonic() + 100
    while not path.exists():
        assert time.monotonic() < until, "the script hangs"
        assert Path(f"/proc/{process}").exists() or path.exists(), "the script has crashed"
        time.sleep(0.002)


def write_points(scripts: ScriptProcesses) -> list[Point]:
    """All write points of the script, from one run without a fault."""
    folder = Path(tempfile.mkdtemp(prefix="points-"))
    try:
        trace = folder / "trace"
        scripts.run(folder, ["-y", "-o", str(trace), "-e", f"trace={','.join(WRITE_CALLS)}"])
        return points_of(trace.read_text(), str(folder / "data"))
    finally:
        shutil.rmtree(folder)


def points_of(trace: str, root: str) -> list[Point]:
    """The write points of a trace's first thread that concern ``root``."""
    counts: dict[str, int] = {}
    found: list[Point] = []
    main = trace.split(maxsplit=1)[0]
    for line in trace.splitlines():
        thread, _, text = line.partition(" ")
        call = re.match(r"\s*(\w+)\(", text)
        if thread != main or call is None:
            continue
        name = call[1]
        counts[name] = counts.get(name, 0) + 1
        reads = name == "openat" and "O_RDONLY" in text and "O_DIRECTORY" not in text
        if root in text and not reads:
            found.append(Point(name, counts[name], text.strip().replace(root, "")))
    return found
