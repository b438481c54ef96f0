"""The watch sees what a program says and writes: whoever makes the call, and whether or not it succeeds."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests.watch import Watch, missing

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
