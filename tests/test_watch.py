"""The watch sees what a program says and writes: whoever makes the call, and whether or not it succeeds."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests import watch as watching
from tests.watch import Seen, Watch, missing

pytestmark = pytest.mark.skipif(bool(missing()), reason=f"nobody can watch what a program does: {missing()}")

PROGRAM = """
import ctypes, os, socket, struct, subprocess, sys, threading
folder, question = sys.argv[1], bytes.fromhex(sys.argv[2])

def connect():  # refused
    with socket.socket() as one:
        one.connect_ex(("127.0.0.1", 1))

thread = threading.Thread(target=connect)
thread.start()
thread.join()
try:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as one:
        one.sendto(b"sent", ("::1", 2))
except OSError:  # this machine has no such network
    pass
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
    one.sendmsg([b"sent"], [], 0, ("127.0.0.1", 3))
    one.connect(("127.0.0.1", 53))
    text = ctypes.create_string_buffer(question)
    part = ctypes.create_string_buffer(struct.pack("QQ", ctypes.addressof(text), len(question)))
    message = ctypes.create_string_buffer(struct.pack("QQQQQQQQ", 0, 0, ctypes.addressof(part), 1, 0, 0, 0, 0))
    ctypes.CDLL(None).sendmmsg(one.fileno(), message, 1, 0)
with socket.socket() as one:
    one.bind(("127.0.0.1", 0))
os.chdir(folder)
subprocess.run(["sh", "-c", "echo > made-by-a-child"])
descriptor = os.open("folder", os.O_RDONLY)
os.close(os.open("renamed", os.O_WRONLY | os.O_CREAT, dir_fd=descriptor))
os.rename("renamed", "../elsewhere", src_dir_fd=descriptor, dst_dir_fd=descriptor)
open("read").close()
open("/dev/null", "w").close()
os.mkdir("made")
"""


def has_ipv6() -> bool:
    """Whether a program can try to say something to an address of IPv6."""
    try:
        socket.socket(socket.AF_INET6, socket.SOCK_DGRAM).close()
    except OSError:
        return False
    return True


def question(name: str) -> bytes:
    """What a name server is asked for the address of a name."""
    labels = b"".join(bytes([len(label)]) + label.encode() for label in name.split("."))
    return bytes.fromhex("0001 0100 0001 0000 0000 0000") + labels + bytes.fromhex("00 0001 0001")


def test_every_call_is_seen(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "read").touch()
    words = [sys.executable, "-B", "-c", PROGRAM, str(tmp_path), question("reports.example").hex()]
    with Watch(tmp_path) as watch:
        subprocess.run([*watch.wrapper, *words], check=True)
    told = {"127.0.0.1:1", "127.0.0.1:3", "127.0.0.1:53", "reports.example"}
    assert watch.told() == told | ({"[::1]:2"} if has_ipv6() else set())
    assert watch.listened() == {"127.0.0.1:0"}
    made = {"made-by-a-child", "folder/renamed", "elsewhere", "made"}
    assert watch.written() == {str(tmp_path / name) for name in made}
    assert watch.written([tmp_path]) == set()


def test_nothing_is_changed_for_the_program(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, Watch(tmp_path) as watch:
        code = f"import socket, sys; socket.create_connection(('127.0.0.1', {server.getsockname()[1]})); sys.exit(3)"
        done = subprocess.run([*watch.wrapper, sys.executable, "-c", code])
    assert done.returncode == 3


@pytest.mark.timeout(60)
def test_a_watch_that_fails_ends_with_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> list[Seen]:
        raise ValueError("nobody can read this")

    monkeypatch.setattr(watching, "_look", broken)
    with pytest.raises(RuntimeError, match="has ended before") as told, Watch(tmp_path) as watch:
        done = subprocess.run(
            [*watch.wrapper, sys.executable, "-c", f"import os; os.mkdir({str(tmp_path / 'made')!r})"]
        )
    assert done.returncode != 0 and not (tmp_path / "made").exists()
    assert isinstance(told.value.__cause__, ValueError)


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "program", ["raise SystemExit(3)", "import sys, socket as s; s.socket(s.AF_UNIX).connect(sys.argv[1])"]
)
def test_a_program_that_puts_itself_under_no_watch_is_waited_for_no_longer(program: str, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="has ended before"), Watch(tmp_path) as watch:
        subprocess.run([sys.executable, "-c", program, watch.wrapper[-1]])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("constant", "value", "said"),
    [
        ("_CONTINUE", 1 << 31, "Invalid argument"),
        ("_memory", lambda *_: (_ for _ in ()).throw(PermissionError()), "memory"),
    ],
    ids=["a kernel that cannot let a call go on", "a process that may read no other"],
)
@pytest.mark.timeout(60)
def test_what_is_missing_is_said(constant: str, value: object, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watching, constant, value)
    assert said in missing.__wrapped__()
