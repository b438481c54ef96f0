"""A real nginx with the configurations of docker/ in front of services."""

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.service.server import ROOT, free_port

NGINX = """
daemon off;
pid {folder}/nginx.pid;
error_log {folder}/error.log;
events {{}}
http {{
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
    include {folder}/{name};
}}
"""


@contextmanager
def nginx_with(name: str, changes: Mapping[str, str], folder: Path, port: int) -> Iterator[Path]:
    """An nginx with a file of docker/, in which texts are replaced, as long as the block runs; the path of its log.

    Args:
        port: that it listens on after the changes.

    Raises:
        AssertionError: a text is not in the file, nginx refuses it, or it does not listen.
    """
    folder.chmod(0o755)
    log, text = folder / "access.log", (ROOT / "docker" / name).read_text()
    for old, new in {**changes, "/dev/stdout": str(log)}.items():
        assert old in text
        text = text.replace(old, new)
    (folder / name).write_text(text)
    (folder / "nginx.conf").write_text(NGINX.format(folder=folder, name=name))
    words = ["nginx", "-c", str(folder / "nginx.conf"), "-p", str(folder)]
    checked = subprocess.run([*words, "-t"], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    nginx = subprocess.Popen(words)
    try:
        wait_for_listener(nginx, port)
        yield log
    finally:
        nginx.terminate()
        nginx.wait(10)


def wait_for_listener(process: subprocess.Popen[bytes], port: int) -> None:
    """Return when the process listens on a port of this machine; its file with a process id is there before that."""
    until = time.monotonic() + 60
    while True:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        assert process.poll() is None and time.monotonic() < until, f"nobody listens on port {port}"
        time.sleep(0.02)


@contextmanager
def balanced(ports: Sequence[int], folder: Path) -> Iterator[str]:
    """The address of an nginx in front of two services at these ports of this machine, as long as the block runs.

    Raises:
        AssertionError: nginx refuses the configuration.
    """
    port = free_port()
    services = {f"placerec-{number}:8000": f"127.0.0.1:{one}" for number, one in enumerate(ports, 1)}
    with nginx_with("cluster.conf", {**services, "listen 8000": f"listen 127.0.0.1:{port}"}, folder, port):
        yield f"http://127.0.0.1:{port}"
