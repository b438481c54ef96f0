"""Watches what a program, its threads and its children say to others and where they write, by the kernel's own word.

How to use it:

    with Watch(folder) as watch:
        subprocess.run([*watch.wrapper, sys.executable, "-m", …])
    assert watch.told() == {"127.0.0.1:8000"}  # addresses that it connected or sent to, names that it looked up
    assert watch.listened() == set()           # addresses that it bound
    assert watch.written([folder]) == set()    # files outside a folder that it opened for writing, or made

The kernel holds every such call until this process has looked at it (seccomp's notifications), so none is missed,
however short the process is, whether Python or a library made it, and whether or not it succeeds.  Nothing has to be
installed for this.  What is looked up has to be asked of a name server, whose address is seen; of a question to one
the name is noted too.

This file is also the program that ``wrapper`` names: it puts itself under the watch and becomes the other program.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import platform
import queue
import select
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Collection
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType

CACHES = ("NUMBA_CACHE_DIR", "PYTHONPYCACHEPREFIX")
"""Variables that move what is compiled once for this checkout to where it would be taken for something else."""

PROXIES = tuple(
    name for kind in ("http", "https", "ftp", "all", "no") for name in (f"{kind}_proxy", f"{kind}_proxy".upper())
)
"""Variables by which a program speaks to a proxy instead of to whom it means."""

_ARCHITECTURES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
_NUMBERS = {
    "x86_64": {
        "open": 2, "connect": 42, "sendto": 44, "sendmsg": 46, "bind": 49, "rename": 82, "mkdir": 83, "creat": 85,
        "link": 86, "symlink": 88, "mknod": 133, "openat": 257, "mkdirat": 258, "mknodat": 259, "renameat": 264,
        "linkat": 265, "symlinkat": 266, "sendmmsg": 307, "renameat2": 316, "openat2": 437,
    },
    "aarch64": {
        "mknodat": 33, "mkdirat": 34, "symlinkat": 36, "linkat": 37, "renameat": 38, "openat": 56, "bind": 200,
        "connect": 203, "sendto": 206, "sendmsg": 211, "sendmmsg": 269, "renameat2": 276, "openat2": 437,
    },
}  # fmt: skip

_PATHS = {
    "open": (None, 0), "creat": (None, 0), "openat": (0, 1), "openat2": (0, 1), "mkdir": (None, 0), "mkdirat": (0, 1),
    "mknod": (None, 0), "mknodat": (0, 1), "link": (None, 1), "linkat": (2, 3), "symlink": (None, 1),
    "symlinkat": (1, 2), "rename": (None, 1), "renameat": (2, 3), "renameat2": (2, 3),
}  # fmt: skip
"""For each call that writes or makes a file: which argument is the folder's descriptor, and which the path."""

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT

_NEW_LISTENER, _SET_FILTER, _SECCOMP = 8, 1, {"x86_64": 317, "aarch64": 277}
_NO_NEW_PRIVILEGES, _RING = 38, 425  # io_uring_setup: what goes through a ring is no call, so there is none
_NOTIFY, _ALLOW, _REFUSE = 0x7FC00000, 0x7FFF0000, 0x00050000 | errno.ENOSYS
_LOAD, _EQUAL, _ANY_BIT, _RETURN = 0x20, 0x15, 0x45, 0x06
_RECEIVE, _SEND, _CONTINUE = 0xC0502100, 0xC0182101, 1


@dataclass(frozen=True)
class Seen:
    """A call that was watched.

    call: its name.
    target: an address as ``host:port``, the path of a file or of a local socket; "?": it cannot be read; empty: the
        kernel, or a socket that is connected.
    name: that a name server was asked for.
    program: which process made it.
    """

    call: str
    target: str
    program: str
    name: str = ""


class Watch:
    """A watch of the processes that are started with its ``wrapper``, until the last of them has ended.

    Args:
        folder: for a socket of its own.
    """

    def __init__(self, folder: Path) -> None:
        self._path = str(folder / "watch")
        self.seen: list[Seen] = []
        self.wrapper = [sys.executable, "-I", str(Path(__file__).resolve()), self._path]
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(self._path)
        self._socket.listen()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._socket:
            if kind is not None:
                return
            self._socket.shutdown(socket.SHUT_RDWR)  # if no program has come until now, none will
            self._thread.join()
        if self._failure is not None:
            raise RuntimeError("the watch has ended before the programs that it watched") from self._failure

    def told(self) -> set[str]:
        """Addresses that were connected or sent to, and names that were looked up, but for local sockets."""
        return {
            target
            for seen in self.seen
            if seen.call in _SENDS
            for target in (seen.target, seen.name)
            if target and not target.startswith(("/", "@"))
        }

    def listened(self) -> set[str]:
        """Addresses that sockets were bound to, but for local sockets."""
        return {seen.target for seen in self.seen if seen.call == "bind" and seen.target[:1] not in ("", "/", "@")}

    def written(self, own: Collection[Path] = ()) -> set[str]:
        """Files that were written or made, but for devices, the processes' own entries and what lies in ``own``."""
        allowed = ("/dev/", "/proc/", *(f"{folder}/" for folder in own))
        return {
            seen.target for seen in self.seen if seen.call in _PATHS and not (seen.target + "/").startswith(allowed)
        }

    def _run(self) -> None:
        try:
            connection, _ = self._socket.accept()
            with connection:
                _, listeners, _, _ = socket.recv_fds(connection, 1, 1)
            if not listeners:
                raise OSError(errno.ECHILD, "the program is under no watch")
            (listener,) = listeners
            try:
                self._listen(listener)
            finally:
                os.close(listener)  # no call is held any more: those that would be fail
        except BaseException as problem:  # it is told where the watch is waited for
            self._failure = problem

    def _listen(self, listener: int) -> None:
        poll = select.poll()
        poll.register(listener, select.POLLIN)
        while poll.poll()[0][1] & select.POLLIN:  # else the last process has ended
            notice = bytearray(80)
            try:
                fcntl.ioctl(listener, _RECEIVE, notice)
            except OSError as problem:
                if problem.errno in (errno.ENOENT, errno.EINTR):  # the process was killed meanwhile
                    continue
                raise
            number, process, _, call, _, _, *arguments = struct.unpack("<QIIiIQ6Q", notice)
            self.seen += _look(_NAMES[call], process, arguments)
            try:
                fcntl.ioctl(listener, _SEND, struct.pack("<QqiI", number, 0, 0, _CONTINUE))
            except OSError as problem:
                if problem.errno != errno.ENOENT:
                    raise


_MACHINE = platform.machine()
_NAMES = {number: name for name, number in _NUMBERS.get(_MACHINE, {}).items()}
_SENDS = ("connect", "sendto", "sendmsg", "sendmmsg")


@cache
def missing() -> str:
    """Why nothing can be watched here, after one call was held, read and let go; empty if it can."""
    if sys.platform != "linux" or _MACHINE not in _NUMBERS:
        return f"{sys.platform} on {_MACHINE} is not watched"
    with TemporaryDirectory() as folder:
        made = f"{folder}/made"
        watch = Watch(Path(folder))
        words = [*watch.wrapper, sys.executable, "-I", "-c", "import os, sys; os.mkdir(sys.argv[1])", made]
        try:
            with watch:
                done = subprocess.run(words, capture_output=True, text=True)
        except RuntimeError as problem:
            return f"the kernel lets nobody watch: {problem.__cause__}; {done.stderr.strip()}"
        if done.returncode:
            return f"the kernel stops what is watched: {done.stderr.strip()}"
        return "" if made in watch.written() else "the memory of what is watched cannot be read"


def _look(call: str, process: int, arguments: list[int]) -> list[Seen]:
    """What a call does that is held now."""
    try:
        program = Path(f"/proc/{process}/comm").read_text().strip()
        if call in _PATHS:
            return [Seen(call, _path(process, *_PATHS[call], arguments), program)]
        if call in ("connect", "bind"):
            return [Seen(call, _address(_memory(process, arguments[1], arguments[2])), program)]
        if call == "sendto":
            return [Seen(call, _address(_memory(process, arguments[4], arguments[5])), program)]
        if call in ("sendmsg", "sendmmsg"):
            count = 1 if call == "sendmsg" else arguments[2]
            return [
                seen for number in range(count) for seen in _message(call, process, arguments[1] + 64 * number, program)
            ]
        raise AssertionError(f"{call} is held, and nobody knows why")
    except OSError:
        return [Seen(call, "?", str(process))]


def _message(call: str, process: int, header: int, program: str) -> list[Seen]:
    """A message to an address of its own, or a question to a name server."""
    name, length, _, parts, count = struct.unpack("<QIIQQ", _memory(process, header, 32))
    address = _address(_memory(process, name, length)) if name else ""
    question = ""
    if call == "sendmmsg" and count:  # as the C library asks for both kinds of addresses at once
        start, size = struct.unpack("<QQ", _memory(process, parts, 16))
        question = _question(_memory(process, start, min(size, 512)))
    return [Seen(call, address, program, question)] if address or question else []


def _question(data: bytes) -> str:
    """The name in a question to a name server; empty if it is none."""
    labels, at = [], 12
    while at < len(data) and 0 < data[at] < 64:
        labels.append(data[at + 1 : at + 1 + data[at]].decode("ascii", "replace"))
        at += 1 + data[at]
    return ".".join(labels) if len(data) > 16 and data[4:6] == b"\0\1" else ""


def _memory(process: int, address: int, length: int) -> bytes:
    with open(f"/proc/{process}/mem", "rb", buffering=0) as memory:
        return os.pread(memory.fileno(), length, address)


def _address(data: bytes) -> str:
    """A socket's address; empty for none, and for the kernel's own kinds."""
    family = int.from_bytes(data[:2], "little")
    if family == socket.AF_INET:
        return f"{socket.inet_ntop(family, data[4:8])}:{int.from_bytes(data[2:4], 'big')}"
    if family == socket.AF_INET6:
        return f"[{socket.inet_ntop(family, data[8:24])}]:{int.from_bytes(data[2:4], 'big')}"
    if family == socket.AF_UNIX:
        path = data[2:].decode(errors="replace")
        return f"@{path[1:]}" if path.startswith("\0") else "/" + path.partition("\0")[0].lstrip("/")
    return "" if family in (socket.AF_UNSPEC, socket.AF_NETLINK) else f"family {family}"


def _path(process: int, folder: int | None, path: int, arguments: list[int]) -> str:
    """An absolute path, as the process means it."""
    start, text = arguments[path], b""
    while b"\0" not in text and len(text) < 4096:  # not past the end of a page, where nothing may be
        text += _memory(process, start + len(text), 4096 - (start + len(text)) % 4096)
    given = os.fsdecode(text.partition(b"\0")[0])
    if os.path.isabs(given):
        return os.path.normpath(given)
    number = -100 if folder is None else ctypes.c_int(arguments[folder]).value
    base = os.readlink(f"/proc/{process}/cwd" if number == -100 else f"/proc/{process}/fd/{number}")
    return os.path.normpath(os.path.join(base, given))


def _filter() -> bytes:
    """The program by which the kernel decides which calls are held."""
    lines: list[tuple[int, int, int, int]] = [
        (_LOAD, 0, 0, 4),
        (_EQUAL, 1, 0, _ARCHITECTURES[_MACHINE]),
        (_RETURN, 0, 0, _REFUSE),
    ]
    for name, number in _NUMBERS[_MACHINE].items():
        argument = {"open": 1, "openat": 2, "sendto": 4}.get(name)
        block: list[tuple[int, int, int, int]] = []
        if argument is not None:
            block = [(_LOAD, 0, 0, 16 + 8 * argument)]
            block += [(_EQUAL, 0, 1, 0)] if name == "sendto" else [(_ANY_BIT, 1, 0, _WRITING)]
            block += [(_RETURN, 0, 0, _ALLOW)]
        block += [(_RETURN, 0, 0, _NOTIFY)]
        lines += [(_LOAD, 0, 0, 0), (_EQUAL, 0, len(block), number), *block]
    lines += [(_EQUAL, 0, 1, _RING), (_RETURN, 0, 0, _REFUSE), (_RETURN, 0, 0, _ALLOW)]
    return b"".join(struct.pack("<HBBI", *line) for line in lines)


def _install() -> int:
    """Put this thread, and what becomes of it, under a watch; the descriptor by which it is watched."""
    libc = ctypes.CDLL(None, use_errno=True)
    program = ctypes.create_string_buffer(_filter())
    pointer = ctypes.create_string_buffer(struct.pack("<HxxxxxxQ", len(_filter()) // 8, ctypes.addressof(program)))
    if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) == 0:
        listener: int = libc.syscall(_SECCOMP[_MACHINE], _SET_FILTER, _NEW_LISTENER, pointer)
        if listener >= 0:
            return listener
    raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def main() -> None:
    """Become the command behind the watch's socket, watched."""
    watch = socket.socket(socket.AF_UNIX)
    watch.connect(sys.argv[1])
    installed: queue.SimpleQueue[int] = queue.SimpleQueue()
    sent = threading.Event()

    def hand_over() -> None:  # this thread is not watched, so that nothing waits for what it has yet to send
        socket.send_fds(watch, [b"."], [installed.get()])
        sent.set()

    threading.Thread(target=hand_over, daemon=True).start()
    try:
        installed.put(_install())
    except OSError as problem:
        sys.exit(problem.strerror)
    sent.wait()
    os.execvp(sys.argv[2], sys.argv[2:])


if __name__ == "__main__":
    main()
