"""A real server process on a free port, and what its answers must look like."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

from tests.service.forks import ROOT as ROOT
from tests.service.forks import ForkedServer

START_SECONDS = 300.0


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def reserved() -> socket.socket:
    """A socket that holds a free port for a server on this machine: nobody else is given it.

    It never listens, so that who connects is refused. It has SO_REUSEADDR, so that a server that has it can listen.
    """
    held = socket.socket()
    held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    held.bind(("127.0.0.1", 0))
    return held


@contextmanager
def no_service() -> Iterator[str]:
    """The URL of a port that is held and at which nobody listens."""
    with reserved() as held:
        yield f"http://127.0.0.1:{held.getsockname()[1]}"


class Server:
    """``placerec serve`` in a process of its own.

    Args:
        folder: for its data and its log.
        settings: names without the prefix, such as ``{"queue_length": 1}``.
        wrapper: words before the command, such as those of strace.
        key: that the client sends.
        forked: start it off a process that has imported everything; not if it has a wrapper, or has to be where this
            process is, as in a network of its own.
        reservation: of the port that it listens on; it is closed when the server ends. A free port if left out.
        files: the soft and the hard limit of its open files, if it is forked; None: those of this process.
    """

    def __init__(
        self,
        folder: Path,
        settings: Mapping[str, object] | None = None,
        wrapper: Sequence[str] = (),
        key: str | None = None,
        forked: bool = True,
        reservation: socket.socket | None = None,
        files: tuple[int, int] | None = None,
    ) -> None:
        self.reservation = reservation or reserved()
        self.folder, self.port, self.key = folder, int(self.reservation.getsockname()[1]), key
        self.data_dir, self.log_file = folder / "data", folder / "log.jsonl"
        folder.mkdir(parents=True, exist_ok=True)
        environment = {name: value for name, value in os.environ.items() if not name.startswith("PLACEREC_")}
        own = {"host": "127.0.0.1", "port": self.port, "data_dir": self.data_dir, "rehearsal": False}
        own |= {"disk_reserve_bytes": 0}
        own |= settings or {}
        environment |= {f"PLACEREC_{name.upper()}": str(value) for name, value in own.items()}
        self.process: ForkedServer | subprocess.Popen[bytes]
        if wrapper or not forked:
            command = [*wrapper, sys.executable, "-m", "service.commands", "serve"]
            with self.log_file.open("ab") as log:
                self.process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=log)
        else:
            self.process = ForkedServer(environment, self.log_file, files=files)
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        self.client = httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=60, headers=headers)

    def check_running(self) -> None:
        """Fail with the end of the log if the process has ended."""
        status = self.process.poll()
        assert status is None, f"the server ended with {status}:\n{self.log_file.read_text()[-4000:]}"

    def wait(self, path: str = "/readyz", seconds: float = START_SECONDS) -> Server:
        """Return when ``path`` answers 200, which is to be within so many seconds."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.check_running()
            try:
                if self.client.get(path).status_code == 200:
                    return self
            except httpx.TransportError:
                pass
            time.sleep(0.05)
        raise AssertionError(f"the server is not ready:\n{self.log_file.read_text()[-4000:]}")

    def kill(self) -> None:
        """End it as a power cut would."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(60)
        self.client.close()
        self.reservation.close()

    def stop(self) -> int:
        """End it as an operator would; the exit status."""
        self.process.send_signal(signal.SIGTERM)
        status = self.process.wait(60)
        self.client.close()
        self.reservation.close()
        return status

    def lines(self, **wanted: object) -> list[dict[str, Any]]:
        """The lines of its log with these values."""
        written = self.log_file.read_text().splitlines(keepends=True)
        found = [json.loads(line) for line in written if line.endswith("\n")]
        return [line for line in found if all(line.get(name) == value for name, value in wanted.items())]

    def logged_request(self, request_id: str) -> dict[str, Any]:
        """The line of a request."""
        (line,) = self.lines_soon(message="request", request_id=request_id)
        return line

    def lines_soon(self, **wanted: object) -> list[dict[str, Any]]:
        """The lines of its log with these values, at least one: it is written when an answer is on its way."""
        until = time.monotonic() + 60
        while not (lines := self.lines(**wanted)):
            assert time.monotonic() < until, f"no line has {wanted}"
            time.sleep(0.02)
        return lines

    def create_map(self, map_id: str, **fields: object) -> dict[str, Any]:
        """A new map."""
        response = self.client.post("/v1/maps", json={"id": map_id, **fields})
        assert response.status_code == 201, response.text
        made: dict[str, Any] = response.json()
        return made

    def enrol(self, map_id: str, place_id: str, data: bytes, **parameters: object) -> httpx.Response:
        """PUT one frame."""
        return self.client.put(
            f"/v1/maps/{map_id}/places/{place_id}", params=text(parameters), content=data, headers=typed(data)
        )

    def places(self, map_id: str) -> dict[str, dict[str, Any]]:
        """All places of a map by their ids, in the order of their enrolment."""
        found: dict[str, dict[str, Any]] = {}
        cursor: str | None = ""
        while cursor is not None:
            parameters = {"limit": "1000"} | ({"cursor": cursor} if cursor else {})
            page = self.client.get(f"/v1/maps/{map_id}/places", params=parameters).json()
            found |= {item["id"]: item for item in page["items"]}
            cursor = page["next_cursor"]
        return found

    def query(self, map_id: str, data: bytes, **parameters: object) -> dict[str, Any]:
        """The answer to one frame."""
        response = self.client.post(
            f"/v1/maps/{map_id}/query", params=text(parameters), content=data, headers=typed(data)
        )
        assert response.status_code == 200, response.text
        answer: dict[str, Any] = response.json()
        return answer


def text(parameters: Mapping[str, object]) -> dict[str, str]:
    """Parameters of a query string; objects as JSON."""
    return {name: json.dumps(value) if isinstance(value, dict) else str(value) for name, value in parameters.items()}


def typed(data: bytes) -> dict[str, str]:
    """The content type of a frame by its first bytes."""
    if data.startswith(b"\x89PNG"):
        return {"Content-Type": "image/png"}
    return {"Content-Type": "image/webp" if data[8:12] == b"WEBP" else "image/jpeg"}


def assert_problem(response: httpx.Response, status: int, slug: str) -> dict[str, Any]:
    """The canonical error: a problem of this status and type that names its request."""
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = response.json()
    assert problem["type"] == f"urn:placerec:problem:{slug}", problem
    assert problem["status"] == status
    assert problem["title"]
    assert problem["detail"]
    assert problem["instance"] == response.request.url.path
    assert problem["request_id"] == response.headers["x-request-id"]
    assert not re.search(r"Traceback|File \"|site-packages", response.text)
    return problem


def assert_item_problem(item: Mapping[str, Any], status: int, slug: str) -> None:
    """The same for one frame of a batch."""
    assert item["status"] == status, item
    assert item["problem"]["type"] == f"urn:placerec:problem:{slug}"
    assert item["problem"]["status"] == status
    assert item["problem"]["detail"]
