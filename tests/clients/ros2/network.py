"""A network of its own for a test: loopback alone, so that ROS finds nobody but the test's own processes."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CLONE_NEWNET = 0x40000000
OWN = Path("/proc/thread-self/ns/net")


class NoNetwork(Exception):
    """This machine lets the test have no network namespace of its own."""


def _call(name: str, *arguments: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if getattr(libc, name)(*arguments) != 0:
        number = ctypes.get_errno()
        raise NoNetwork(f"{name}: {os.strerror(number)}")


@contextmanager
def own_network() -> Iterator[None]:
    """Put this thread, and the processes and threads that it starts, into a network namespace with loopback alone.

    Raises:
        NoNetwork: that is not allowed here.
    """
    ip = shutil.which("ip") or "/usr/sbin/ip"
    if not OWN.exists() or not Path(ip).exists():
        raise NoNetwork("there is no Linux with the command ip")
    before = os.open(OWN, os.O_RDONLY)
    try:
        _call("unshare", CLONE_NEWNET)
        try:
            for words in (["link", "set", "lo", "up", "multicast", "on"], ["route", "add", "224.0.0.0/4", "dev", "lo"]):
                done = subprocess.run([ip, *words], capture_output=True, text=True)
                if done.returncode:
                    raise NoNetwork(done.stderr.strip())
            yield
        finally:
            _call("setns", before, CLONE_NEWNET)
    finally:
        os.close(before)


def loopback(up: bool) -> None:
    """Mend or cut the network of this thread; cutting it loses the route of multicast, which is put back."""
    ip = shutil.which("ip") or "/usr/sbin/ip"
    subprocess.run([ip, "link", "set", "lo", "up" if up else "down"], check=True)
    if up:
        subprocess.run([ip, "route", "replace", "224.0.0.0/4", "dev", "lo"], check=True)
