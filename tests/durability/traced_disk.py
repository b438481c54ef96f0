"""A model of a disk, made from a trace of a process: what is on it for certain, and what may be, at every moment.

The trace (:func:`arguments`) holds the bytes of every write.  A file's contents are certain when they were written
before a sync of it began that has returned; a name is certain when its folder was synced so.  Everything else a power
cut may keep, lose, or keep in part: :meth:`Disk.image` writes one such disk into a folder.  SQLite's shared memory,
which is mapped and made again, is left out.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from tests.syscalls import strace

WRITES = {"write", "pwrite64", "writev", "pwritev", "pwritev2"}
_LENGTHS = {"ftruncate", "truncate"}
_SYNCS = {"fsync", "fdatasync"}
_NAMES = {"mkdir", "mkdirat", "rename", "renameat", "renameat2", "unlink", "unlinkat", "rmdir"}
_OPENS = {"open", "openat", "creat"}
_UNFOLLOWED = {"fallocate", "copy_file_range", "sendfile", "link", "linkat", "symlink", "symlinkat", "sync", "syncfs"}
_TOLD = {"sendto", "sendmsg"}

TRACED = sorted(WRITES | _LENGTHS | _SYNCS | _NAMES | _OPENS | _UNFOLLOWED | _TOLD)

_LINE = re.compile(r"^(?P<thread>\d+)\s+(?P<text>.*)$", re.DOTALL)
_CALL = re.compile(r"^(?P<name>\w+)\((?P<arguments>.*)\)\s+= (?P<result>-?\w+)", re.DOTALL)
_RESUMED = re.compile(r"^<\.\.\. \w+ resumed>\s?(?P<rest>.*)$", re.DOTALL)
_STRING = re.compile(r'"((?:\\x[0-9a-f]{2})*)"')
_DESCRIPTOR = re.compile(r"^(?:\d+|AT_FDCWD)<((?:\\x[0-9a-f]{2})*)>(\(deleted\))?")
_FOLDER = re.compile(r"(?:\d+|AT_FDCWD)<((?:\\x[0-9a-f]{2})*)>, $")

SECTOR = 512


def arguments(trace_file: Path) -> list[str]:
    """The words before a command, or before ``-p`` and a process id, that trace it so that it can be replayed."""
    calls = f"trace={','.join(TRACED)}"
    return [strace() or "strace", "-f", "-y", "-xx", "-s", str(1 << 24), "-e", calls, "-o", str(trace_file)]


def _bytes(hexadecimal: str) -> bytes:
    return bytes.fromhex(hexadecimal.replace("\\x", ""))


@dataclass(eq=False)
class _Step:
    """A write to a file: bytes at an offset, or (``data`` is None) its length from here on.  ``ended`` is a line."""

    offset: int
    data: bytes | None
    ended: int | None = None


@dataclass(eq=False)
class _File:
    certain: bytearray = field(default_factory=bytearray)
    open: list[_Step] = field(default_factory=list)
    position: int = 0

    def sync(self, begun: int) -> None:
        covered = [step for step in self.open if step.ended is not None and step.ended < begun]
        for step in covered:
            _apply(self.certain, step)
        self.open = [step for step in self.open if step not in covered]


@dataclass(eq=False)
class _Folder:
    names: dict[str, _File | _Folder] = field(default_factory=dict)
    certain: dict[str, _File | _Folder] = field(default_factory=dict)
    open: list[tuple[int, dict[str, _File | _Folder | None]]] = field(default_factory=list)

    def change(self, line: int, changes: dict[str, _File | _Folder | None]) -> None:
        self.open.append((line, changes))
        _rename(self.names, changes)

    def sync(self, begun: int) -> None:
        for line, changes in self.open:
            if line < begun:
                _rename(self.certain, changes)
        self.open = [(line, changes) for line, changes in self.open if line >= begun]


def _rename(names: dict[str, _File | _Folder], changes: dict[str, _File | _Folder | None]) -> None:
    for name, what in changes.items():
        if what is None:
            names.pop(name, None)
        else:
            names[name] = what


def _apply(content: bytearray, step: _Step) -> None:
    if step.data is None:
        del content[step.offset :]
        content.extend(bytes(step.offset - len(content)))
        return
    content.extend(bytes(max(0, step.offset - len(content))))
    content[step.offset : step.offset + len(step.data)] = step.data


def _torn(step: _Step, random: Random) -> Iterator[_Step]:
    """Some of the sectors of a write."""
    if step.data is None:
        yield step
        return
    start = 0
    while start < len(step.data):
        stop = min(len(step.data), start + SECTOR - (step.offset + start) % SECTOR)
        if random.random() < 0.5:
            yield _Step(step.offset + start, step.data[start:stop])
        start = stop


@dataclass(frozen=True)
class Variant:
    """What a power cut does to writes that are not certain.

    data: share of the writes that are kept; torn: of those that are kept, only some sectors.
    names: share of each folder's changes that are kept, from the first on, as a journal does.
    """

    data: float = 0.0
    names: float = 0.0
    torn: bool = False


CERTAIN = Variant()
"""Only what was synced."""

VARIANTS = (CERTAIN, Variant(0, 1), Variant(1, 0), Variant(0.5, 1, True), Variant(0.5, 0.5, True), Variant(0.5, 0.5))


class Disk:
    """The files below a folder that is empty when the trace begins."""

    def __init__(self, root: Path) -> None:
        self._root = str(root)
        self._top = _Folder()
        self.writes, self.syncs = 0, 0

    # The trace

    def replay(self, trace: Iterator[str], is_told: Callable[[bytes], str | None]) -> Iterator[str | None]:
        """Follow a trace; yields after every change of what is on the disk or may be, and for every answer.

        Args:
            is_told: which answer the bytes are that were sent, if any.

        Yields:
            the answer that begins to be sent, or None after a change.
        """
        begun: dict[str, tuple[int, str, _Step | None]] = {}
        for line, raw in enumerate(trace, start=1):
            found = _LINE.match(raw.rstrip("\n"))
            if found is None:
                continue
            thread, text = found["thread"], found["text"]
            if resumed := _RESUMED.match(text):
                start, before, step = begun.pop(thread)
                call = _CALL.match(before + resumed["rest"])
                if call is not None and self._end(call, start, line, step):
                    yield None
                continue
            unfinished = text.endswith("<unfinished ...>")
            name, _, given = text.partition("(")
            step = None
            if name in WRITES | _TOLD and (sent := self._sent(name, given)) is not None:
                if (told := is_told(sent)) is not None:
                    yield told
            elif name in WRITES | _LENGTHS:
                step = self._write(name, given)
            if unfinished:
                begun[thread] = (line, text.removesuffix("<unfinished ...>").rstrip(), step)
                if step is not None:
                    yield None
            elif (call := _CALL.match(text)) is not None and self._end(call, line, line, step):
                yield None

    def _sent(self, name: str, given: str) -> bytes | None:
        """What goes to a socket or a pipe."""
        found = _DESCRIPTOR.match(given)
        if found is None or _bytes(found[1]).startswith(b"/"):
            return None
        return b"".join(_bytes(text) for text in _STRING.findall(given))

    def _write(self, name: str, given: str) -> _Step | None:
        assert name != "truncate", "a file is cut by its name, which is not followed"
        found = _DESCRIPTOR.match(given)
        if found is None or found[2]:
            return None  # nothing that has a name
        path = _bytes(found[1]).decode()
        if not self._within(path):
            return None
        file = self._find(path)
        assert isinstance(file, _File), path
        numbers = re.search(r"(?:, (\d+))?, (\d+)\)?(?:\s+= .*|\s*<unfinished.*)?$", given)
        assert numbers is not None, given[-200:]
        if name in _LENGTHS:
            step = _Step(int(numbers[2]), None)
        else:
            data = b"".join(_bytes(text) for text in _STRING.findall(given))
            offset = file.position if name in ("write", "writev") else int(numbers[2])
            file.position = offset + len(data) if name in ("write", "writev") else file.position
            step = _Step(offset, data)
        self.writes += 1
        file.open.append(step)
        return step

    def _end(self, call: re.Match[str], begun: int, line: int, step: _Step | None) -> bool:
        """What a call that has returned has changed; whether anything."""
        name, given, failed = call["name"], call["arguments"], call["result"].startswith("-")
        if step is not None:
            assert not failed and (step.data is None or int(call["result"]) == len(step.data)), call[0][-200:]
            step.ended = line
            return True
        if failed:
            return False
        if name in _SYNCS:
            found = _DESCRIPTOR.match(given)
            what = None if found is None else self._find(_bytes(found[1]).decode())
            if what is not None:
                what.sync(begun)
                self.syncs += 1
            return what is not None
        paths = self._paths(given)
        if not any(self._within(path) for path in paths):
            return False
        assert name not in _UNFOLLOWED, f"{name} is not followed: {paths}"
        if name in _OPENS:
            return self._opened(name, paths[0], given, line)
        if name in _NAMES:
            self._named(name, paths, given, line)
        return name in _NAMES

    def _opened(self, name: str, path: str, given: str, line: int) -> bool:
        there = self._find(path)
        if there is None and (name == "creat" or "O_CREAT" in given):
            self._folder(path).change(line, {os.path.basename(path): _File()})
            return True
        if isinstance(there, _File):
            there.position = 0
            if "O_TRUNC" in given:
                there.open.append(_Step(0, None, line))
                return True
        return False

    def _named(self, name: str, paths: list[str], given: str, line: int) -> None:
        last = os.path.basename(paths[0])
        if paths[0] == self._root:
            return  # the folder itself is made; it is taken to be there
        folder = self._folder(paths[0])
        if name.startswith("mkdir"):
            folder.change(line, {last: _Folder()})
        elif name.startswith("rename"):
            target, new = self._folder(paths[1]), os.path.basename(paths[1])
            what = folder.names[last]
            if target is folder:
                folder.change(line, {last: None, new: what})
            else:
                target.change(line, {new: what})
                folder.change(line, {last: None})
        else:
            folder.change(line, {last: None})

    def _paths(self, given: str) -> list[str]:
        paths = []
        for found in _STRING.finditer(given):
            before = _FOLDER.search(given[: found.start()])
            folder = _bytes(before[1]).decode() if before else "/"
            paths.append(os.path.normpath(os.path.join(folder, _bytes(found[1]).decode(errors="replace"))))
        return paths

    def _within(self, path: str) -> bool:
        return path == self._root or path.startswith(self._root + "/")

    def _find(self, path: str) -> _File | _Folder | None:
        if not self._within(path):
            return None
        what: _File | _Folder | None = self._top
        for name in Path(path).relative_to(self._root).parts:
            what = what.names.get(name) if isinstance(what, _Folder) else None
        return what

    def _folder(self, path: str) -> _Folder:
        found = self._find(os.path.dirname(path))
        assert isinstance(found, _Folder), path
        return found

    # What a power cut leaves

    def image(self, folder: Path, variant: Variant, random: Random) -> None:
        """Write a disk into a folder that is not there yet."""
        folder.mkdir(parents=True)
        _write_folder(self._top, folder, variant, random)


def _write_folder(what: _Folder, folder: Path, variant: Variant, random: Random) -> None:
    names = dict(what.certain)
    kept = round(variant.names * len(what.open)) if variant.names in (0, 1) else random.randint(0, len(what.open))
    for _, changes in what.open[:kept]:
        _rename(names, changes)
    for name, inner in names.items():
        if isinstance(inner, _Folder):
            (folder / name).mkdir()
            _write_folder(inner, folder / name, variant, random)
        elif not name.endswith("-shm"):
            (folder / name).write_bytes(_content(inner, variant, random))


def _content(file: _File, variant: Variant, random: Random) -> bytes:
    content = bytearray(file.certain)
    for step in file.open:
        if random.random() < variant.data:
            for part in _torn(step, random) if variant.torn else (step,):
                _apply(content, part)
    return bytes(content)
