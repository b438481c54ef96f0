"""Audits a trace of system calls: was everything synced before it was acknowledged?

How to use it:

    subprocess.run([*strace_arguments(trace_file), sys.executable, "-m", …])
    report = audit(trace_file.read_text(), root=data_directory, is_acknowledgement=is_success_response)
    assert report.acknowledgements >= 10 and report.syncs > 0   # the trace is not an empty one
    assert report.violations == []

``audit`` walks through the trace.  It notes which files under ``root`` were written and in which
folders names were made or renamed, and takes off those that were synced since.  What is still noted
when an acknowledgement is begun is a violation.  An acknowledgement is whatever call the predicate
says, such as :func:`is_marker` (a line on standard output that begins with ``ack``) or
:func:`is_success_response` (the first bytes of a 2xx answer of HTTP/1.1).

The rules, where there is a choice:

* A write counts from the moment it begins; a sync covers only what was written before it began, and
  counts when it has returned 0.  Calls that other threads interrupt are put together.
* ``fsync`` and ``fdatasync`` both make contents durable; for names the folder itself must be synced.
* A file that was written under a temporary name and renamed must have been synced under either name.
* A name that is removed takes what was written to it along.  Removing is not to be durable by itself.
* ``existing`` names files that were there before the trace began, so that opening them with O_CREAT
  makes no name.
* A shared, writable mapping of a file is a violation of its own: a trace does not show what is
  written through it.
* One client at a time: whatever any thread wrote must be synced, for a trace does not say which
  acknowledgement a write belongs to.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path

_WRITES = {"write", "pwrite64", "writev", "pwritev", "pwritev2", "ftruncate", "fallocate", "sendfile"}
_SYNCS = {"fsync", "fdatasync"}
_OPENS = {"open", "openat", "creat"}
_MADE = {"mkdir", "mkdirat", "mknod", "mknodat", "symlink", "symlinkat", "link", "linkat"}
_RENAMES = {"rename", "renameat", "renameat2"}
_REMOVALS = {"unlink", "unlinkat", "rmdir"}
_OTHERS = {"truncate", "mmap", "sendto", "sendmsg", "syncfs", "sync", "copy_file_range"}

TRACED = sorted(_WRITES | _SYNCS | _OPENS | _MADE | _RENAMES | _REMOVALS | _OTHERS)
"""The calls that a trace must show."""

_LINE = re.compile(r"^(?:\[pid\s+(?P<bracketed>\d+)\]\s+|(?P<pid>\d+)\s+)?(?P<text>.*)$")
_CALL = re.compile(r"^(?P<name>\w+)\((?P<arguments>.*)\)\s+= (?P<result>-?\w+)", re.DOTALL)
_UNFINISHED = re.compile(r"^(?P<start>.*?)\s*<unfinished \.\.\.>$")
_RESUMED = re.compile(r"^<\.\.\. (?P<name>\w+) resumed>\s?(?P<rest>.*)$")
_DESCRIPTOR = re.compile(r"^(?:\d+|AT_FDCWD)<(?P<path>(?:[^>\\]|\\.)*)>")
_STRING = re.compile(r'"(?P<text>(?:[^"\\]|\\.)*)"(?P<cut>\.\.\.)?')


def strace() -> str | None:
    """The path of strace, or None if it is missing or may not trace here; tests skip without it."""
    found = shutil.which("strace")
    if found is None:
        return None
    tried = subprocess.run([found, "-o", os.devnull, "true"], capture_output=True, check=False)
    return found if tried.returncode == 0 else None


def strace_arguments(trace_file: Path, *extra: str) -> list[str]:
    """The words before a command that write a trace of it, its threads and its children."""
    return [
        strace() or "strace",
        "-f",
        "--seccomp-bpf",  # what is not traced runs at its own speed
        "-y",
        "-s",
        "96",
        "-e",
        f"trace={','.join(TRACED)}",
        "-o",
        str(trace_file),
        *extra,
    ]


def is_marker(call: str) -> bool:
    """A line that begins with ``ack``, written to standard output."""
    return re.match(r'^write\(1(<[^>]*>)?, "ack', call) is not None


def is_success_response(call: str) -> bool:
    """The beginning of a 2xx answer of HTTP/1.1, by whichever call it is sent."""
    return re.match(r'^(write|writev|sendto|sendmsg)\(\d+[^"]*"HTTP/1\.1 2\d\d ', call) is not None


def is_sqlite_index(path: str) -> bool:
    """SQLite's shared-memory index of its log: never synced, for it is made again from the log after a crash."""
    return path.endswith("-shm")


@dataclass
class Report:
    """What a trace shows."""

    acknowledgements: int = 0
    writes: int = 0
    syncs: int = 0
    violations: list[str] = field(default_factory=list)


@dataclass
class _Ledger:
    root: str
    is_ignored: Callable[[str], bool]
    known: set[str]
    contents: dict[str, int] = field(default_factory=dict)  # path → line of the last write
    names: dict[str, int] = field(default_factory=dict)  # folder → line at which a name was made last

    def concerns(self, path: str | None) -> bool:
        inside = path is not None and (path == self.root or path.startswith(self.root + "/"))
        return inside and path is not None and not self.is_ignored(path)

    def name_made(self, path: str, line: int) -> None:
        self.known.add(path)
        folder = os.path.dirname(path)
        if self.concerns(path) and self.concerns(folder):
            self.names[folder] = line

    def synced(self, path: str, begun: int) -> None:
        for noted in (self.contents, self.names):
            if noted.get(path, begun) < begun:
                del noted[path]

    def removed(self, path: str) -> None:
        self.known.discard(path)
        for noted in (self.contents, self.names):
            noted.pop(path, None)

    def renamed(self, old: str, new: str, line: int) -> None:
        """All that was noted of ``old``, and of what lies in it, is now noted of ``new``."""
        for noted in (self.contents, self.names):
            noted.pop(new, None)
            for path in [path for path in noted if path == old or path.startswith(old + "/")]:
                noted[new + path[len(old) :]] = noted.pop(path)
        self.known = {
            new + path[len(old) :] if path == old or path.startswith(old + "/") else path for path in self.known
        }
        self.name_made(new, line)


def _first_path(arguments: str) -> str | None:
    """The file behind a call's first argument, a descriptor."""
    found = _DESCRIPTOR.match(arguments)
    return None if found is None or found["path"].endswith("(deleted)") else found["path"]


def _named_paths(arguments: str) -> list[str]:
    """The paths that a call names, each relative to the folder descriptor before it."""
    paths = []
    for found in _STRING.finditer(arguments):
        before = re.search(r"(?:\d+|AT_FDCWD)<((?:[^>\\]|\\.)*)>, $", arguments[: found.start()])
        paths.append(os.path.normpath(os.path.join(before[1] if before else "/", found["text"])))
    return paths


def _begin(ledger: _Ledger, report: Report, name: str, arguments: str, line: int) -> None:
    """What counts from the moment a call begins."""
    path: str | None = None
    if name in _WRITES:
        path = _first_path(arguments)
    elif name == "truncate":
        path = _named_paths(arguments)[0]
    elif name == "copy_file_range":
        path = _first_path(arguments.split(", ", 2)[2])
    elif name == "mmap" and "PROT_WRITE" in arguments and "MAP_SHARED" in arguments:
        mapped = re.search(r", \d+<((?:[^>\\]|\\.)*)>, ", arguments)
        if mapped and ledger.concerns(mapped[1]):
            report.violations.append(f"line {line}: {mapped[1]} is mapped for writing, which a trace cannot follow")
    if path is not None and ledger.concerns(path):
        ledger.contents[path] = line
        report.writes += 1


def _end(ledger: _Ledger, report: Report, call: re.Match[str], begun: int, line: int) -> None:
    """What counts when a call has returned."""
    name, arguments, failed = call["name"], call["arguments"], call["result"].startswith("-")
    if failed:
        return
    if name in _SYNCS:
        path = _first_path(arguments)
        if path is not None and ledger.concerns(path):
            report.syncs += 1
            ledger.synced(path, begun)
    elif name in {"sync", "syncfs"}:
        for path in [*ledger.contents, *ledger.names]:
            ledger.synced(path, begun)
    elif name in _OPENS:
        path = _named_paths(arguments)[0]
        if (name == "creat" or "O_CREAT" in arguments) and path not in ledger.known:
            ledger.name_made(path, line)
        ledger.known.add(path)
    elif name in _MADE:
        ledger.name_made(_named_paths(arguments)[-1], line)
    elif name in _RENAMES:
        old, new = _named_paths(arguments)
        ledger.renamed(old, new, line)
    elif name in _REMOVALS:
        ledger.removed(_named_paths(arguments)[0])


def audit(
    trace: str,
    root: Path,
    is_acknowledgement: Callable[[str], bool],
    existing: Collection[Path] = (),
    is_ignored: Callable[[str], bool] = is_sqlite_index,
) -> Report:
    """Find what was not synced at each acknowledgement.

    Args:
        trace: the output of ``strace -f -y``, with at least the calls in :data:`TRACED`.
        root: only what lies within counts; an absolute path without links.
        is_acknowledgement: whether a call, written as strace does, tells someone that all is done.
        existing: files and folders within ``root`` that were there before.
        is_ignored: paths that need no sync.
    """
    ledger = _Ledger(str(root), is_ignored, {str(path) for path in existing})
    report = Report()
    begun_by_thread: dict[str, tuple[int, str]] = {}
    for line, raw in enumerate(trace.splitlines(), start=1):
        parsed = _LINE.match(raw)
        assert parsed is not None
        thread, text = parsed["pid"] or parsed["bracketed"] or "", parsed["text"]
        begun = line
        if resumed := _RESUMED.match(text):
            begun, start = begun_by_thread.pop(thread, (line, f"{resumed['name']}("))
            text = start + resumed["rest"]
        else:
            unfinished = _UNFINISHED.match(text)
            started = unfinished["start"] if unfinished else text
            name, _, arguments = started.partition("(")
            if unfinished:
                begun_by_thread[thread] = (line, started)
            if is_acknowledgement(started):
                report.acknowledgements += 1
                for path, when in sorted((ledger.contents | ledger.names).items()):
                    report.violations.append(f"line {line}: {started[:80]}: {path} (line {when}) is not synced")
            if name in TRACED:
                _begin(ledger, report, name, arguments, line)
            if unfinished:
                continue
        if call := _CALL.match(text):
            _end(ledger, report, call, begun, line)
    return report
