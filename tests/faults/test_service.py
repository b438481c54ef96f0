"""Faults under a running service: it refuses what it cannot do, goes on otherwise, and recovers without a restart."""

from __future__ import annotations

import os
import re
import resource
import signal
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.store import Directory
from tests.core.store.frames import frame
from tests.faults.injection import attached
from tests.service.damage import damage
from tests.service.places.test_durability import answers
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem
from tests.service.wire import eventually
from tests.syscalls import strace

needs_strace = pytest.mark.skipif(strace() is None, reason="strace is not installed, or may not trace here")

WRITES = "pwrite64,ftruncate,fsync,fdatasync,mkdir,rename"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("faults")


@pytest.fixture(scope="module")
def clock(folder: Path) -> Path:
    """The file with the seconds by which the service's wall clock is off."""
    path = folder / "clock"
    path.write_text("0")
    return path


@pytest.fixture(scope="module")
def server(folder: Path, clock: Path) -> Iterator[Server]:
    """One service for all tests here, with a map that nobody writes to."""
    prepare(folder / "server" / "data", folder / "server" / "models")
    wrapper = (sys.executable, "-m", "tests.faults.clock", str(clock))
    running = Server(folder / "server", {"models_dir": folder / "server" / "models"}, wrapper)
    running.wait()
    running.create_map("hall")
    for number in range(2):
        assert running.enrol("hall", f"h{number}", jpeg(50 + number)).status_code == 201
    yield running
    assert running.stop() == 0


@pytest.fixture
def lab(server: Server) -> Iterator[str]:
    """A map with two places, gone after the test; and a check that no fault has changed the other one."""
    server.check_running()
    before = answers(server, "hall", [jpeg(50)])
    server.create_map("lab")
    for number in range(2):
        assert server.enrol("lab", f"p{number}", jpeg(number)).status_code == 201
    yield "lab"
    assert answers(server, "hall", [jpeg(50)]) == before
    assert server.client.delete("/v1/maps/lab").status_code == 204
    assert server.client.get("/readyz").status_code in (200, 503)
    server.check_running()


@contextmanager
def faults(server: Server, *arguments: str) -> Iterator[None]:
    """Inject faults into the running service."""
    calls = [argument.partition(":")[0] for argument in arguments]
    options = [word for argument in arguments for word in ("-e", f"inject={argument}")]
    with attached(server.process.pid, ["-o", "/dev/null", "-e", f"trace={','.join(calls)}", *options]):
        yield


def check_refused(server: Server, status: int, slug: str) -> None:
    """Writes are answered with a problem, queries and other maps go on, and nothing was half written."""
    before = server.places("lab")
    assert_problem(server.enrol("lab", "refused", jpeg(7)), status, slug)
    assert_problem(server.client.patch("/v1/maps/lab", json={"description": "refused"}), status, slug)
    assert_problem(server.client.post("/v1/maps", json={"id": "refused"}), status, slug)
    assert server.query("lab", jpeg(1))["matches"][0]["place"]["id"] == "p1"
    assert server.query("hall", jpeg(50))["matches"][0]["place"]["id"] == "h0"
    assert server.places("lab") == before
    assert server.client.get("/livez").status_code == 200


def check_recovered(server: Server) -> None:
    """What was refused is not there, the next write succeeds, and the map is sound."""
    assert "refused" not in server.places("lab")
    assert server.client.get("/v1/maps/refused").status_code == 404
    assert server.client.get("/v1/maps/lab").json()["description"] == ""
    response = server.enrol("lab", "taken", jpeg(8))
    assert response.status_code == 201, response.text
    assert server.query("lab", jpeg(8))["matches"][0]["place"]["id"] == "taken"
    assert server.client.post("/v1/maps/lab/verify").json()["ok"]
    wait_for_readiness(server, 200)


def wait_for_readiness(server: Server, status: int) -> httpx.Response:
    """The answer of the probe, which looks at the disk once a second."""
    until = time.monotonic() + 60
    while (response := server.client.get("/readyz")).status_code != status and time.monotonic() < until:
        time.sleep(0.1)
    assert response.status_code == status, response.text
    return response


def degraded_soon(server: Server, expected: bool = True) -> str | None:
    """Why the service, which is ready, takes no writes; the probe looks at the disk once a second."""
    assert eventually(lambda: (wait_for_readiness(server, 200).json()["degraded"] is not None) == expected, seconds=60)
    return str(wait_for_readiness(server, 200).json()["degraded"]) if expected else None


@pytest.mark.thorough
@needs_strace
@pytest.mark.parametrize(
    ("error", "status", "slug"), [("ENOSPC", 507, "storage-full"), ("EIO", 500, "storage-failure")]
)
def test_a_disk_that_refuses_to_write(server: Server, lab: str, error: str, status: int, slug: str) -> None:
    with faults(server, f"{WRITES}:error={error}"):
        # SQLite tells of a failed sync as of an I/O error, whatever its cause; a full disk fails as it is written to.
        check_refused(server, status, slug)
        if error == "EIO":
            assert "disk" in wait_for_readiness(server, 503).json()["detail"]
        else:
            assert "The disk is full" in (degraded_soon(server) or "")
            assert server.client.get("/v1/service").json()["ready"]
            assert re.search(r"^placerec_degraded 1\.0$", server.client.get("/metrics").text, re.MULTILINE)
    check_recovered(server)
    degraded_soon(server, expected=False)


@needs_strace
def test_a_disk_that_is_read_only(server: Server, lab: str) -> None:
    with faults(server, f"{WRITES},unlink:error=EROFS"):
        check_refused(server, 500, "storage-failure")
    check_recovered(server)


@needs_strace
def test_a_sync_that_takes_seconds_keeps_no_query_waiting(server: Server, lab: str) -> None:
    with ThreadPoolExecutor(1) as pool, httpx.Client(base_url=server.client.base_url, timeout=60) as other:
        with faults(server, "fsync,fdatasync:delay_enter=30000000"):
            slow = pool.submit(
                other.put, "/v1/maps/lab/places/slow", content=jpeg(9), headers={"Content-Type": "image/jpeg"}
            )
            time.sleep(0.2)
            for number in range(2):
                assert server.query("lab", jpeg(number))["matches"][0]["place"]["id"] == f"p{number}"
            assert server.client.get("/livez").status_code == 200
            assert not slow.done(), "the queries were answered while the write waited for its sync"
        assert slow.result(60).status_code == 201
    assert server.query("lab", jpeg(9))["matches"][0]["place"]["id"] == "slow"
    wait_for_readiness(server, 200)


def open_files(server: Server) -> int:
    return len(os.listdir(f"/proc/{server.process.pid}/fd"))


def test_no_file_descriptor_is_left(server: Server, lab: str) -> None:
    server.query("lab", jpeg(0))
    process, (soft, hard) = server.process.pid, resource.prlimit(server.process.pid, resource.RLIMIT_NOFILE)
    resource.prlimit(process, resource.RLIMIT_NOFILE, (min(open_files(server), soft), hard))
    try:
        refused = server.client.post("/v1/maps", json={"id": "refused"})
        assert_problem(refused, 503, "too-many-open-files")
        assert 1 <= int(refused.headers["Retry-After"]) <= 3
        assert server.enrol("lab", "open", jpeg(7)).status_code == 201, "the files of this map are open"
        assert server.query("lab", jpeg(7))["matches"][0]["place"]["id"] == "open"
        assert server.query("hall", jpeg(50))["matches"][0]["place"]["id"] == "h0"
        assert server.client.get("/livez").status_code == 200
    finally:
        resource.prlimit(process, resource.RLIMIT_NOFILE, (soft, hard))
    check_recovered(server)


@pytest.mark.thorough
def test_a_data_directory_that_disappears_for_a_while(server: Server, lab: str) -> None:
    away = server.data_dir.with_name("away")
    server.data_dir.rename(away)
    try:
        assert_problem(server.client.post("/v1/maps", json={"id": "refused"}), 500, "storage-failure")
        assert server.enrol("lab", "open", jpeg(7)).status_code == 201, "it is written to the file that is away"
        assert server.query("lab", jpeg(1))["matches"][0]["place"]["id"] == "p1"
        assert "disk" in wait_for_readiness(server, 503).json()["detail"]
    finally:
        away.rename(server.data_dir)
    check_recovered(server)
    assert "open" in server.places("lab")


@pytest.mark.thorough
def test_a_clock_that_jumps(server: Server, lab: str, clock: Path) -> None:
    """By hours to either side: sessions and deadlines go on, and what is read afterwards is what was written."""
    session = server.client.post("/v1/maps/lab/sessions", json={"expires_after": 600}).json()["id"]

    def frame(number: int) -> httpx.Response:
        path = f"/v1/maps/lab/sessions/{session}/frames"
        return server.client.post(path, content=jpeg(0), headers={"Content-Type": "image/jpeg"})

    assert frame(0).status_code == 200
    try:
        for number, offset in enumerate((5 * 3600, -5 * 3600, 0)):
            clock.write_text(str(offset))
            assert frame(number + 1).status_code == 200, "a session ends by the time that went by, not by the clock"
            response = server.enrol("lab", f"at-{number}", jpeg(20 + number))
            assert response.status_code == 201
            made = datetime.fromisoformat(response.json()["created_at"]).timestamp()
            assert abs(made - time.time() - offset) < 300
            assert server.query("lab", jpeg(20 + number))["matches"][0]["place"]["id"] == f"at-{number}"
            job = server.client.post("/v1/maps/lab/verify", params={"background": "true"}).json()
            if "id" in job:
                ended = server.client.get(f"/v1/jobs/{job['id']}", params={"wait": "20"}).json()
                assert ended["state"] == "succeeded"
    finally:
        clock.write_text("0")
    order = [place["id"] for place in server.client.get("/v1/maps/lab/places").json()["items"]]
    assert order == ["p0", "p1", "at-0", "at-1", "at-2"], "by enrolment, whatever the clock said"
    assert server.client.post("/v1/maps/lab/verify").json()["ok"]


def png(pixels: NDArray[np.uint8]) -> bytes:
    """A picture as a PNG file."""
    return cv2.imencode(".png", pixels)[1].tobytes()


def prepare(data: Path, models: Path) -> None:
    """A sound map, a damaged one, and damage to every file beside the maps; descriptors are made up."""
    (encoder,) = (one for one in EncoderCatalogue().describe() if one.name == DEFAULT_ENCODER)
    atlas = Directory(data)
    for name in ("sound", "damaged"):
        made = atlas.create(name, encoder.identity, encoder.dimension, local_shape=encoder.local_shape)
        made.enrol([frame("p0", dimension=encoder.dimension, local_shape=encoder.local_shape)])
    atlas.close()
    damage(data, "damaged")
    models.mkdir()
    (models / "broken.encoder.safetensors").write_bytes(b"\xff" * 4096)
    for name, content in DAMAGED_FILES.items():
        (data / name).write_bytes(content)


DAMAGED_FILES = {
    "jobs.sqlite": b"SQLite format 3\x00" + b"\xff" * 8176,
    "sessions.sqlite": b"\x00" * 4096,
    "statistics.sqlite": b"no database at all",
    "history.sqlite": b"\x01" * 4096,
}


def test_damaged_files_at_the_start(server: Server) -> None:
    """With a damaged map, a damaged model and every small file damaged, the rest is served."""
    client, headers = server.client, {"Content-Type": "image/jpeg"}
    assert server.query("sound", jpeg(0))["matches"][0]["place"]["id"] == "p0"
    refused = client.post("/v1/maps/damaged/query", content=jpeg(0), headers=headers)
    assert_problem(refused, 503, "map-quarantined")
    assert_problem(client.put("/v1/maps/damaged/places/p1", content=jpeg(0), headers=headers), 503, "map-quarantined")
    report: dict[str, Any] = client.post("/v1/maps/damaged/verify").json()
    assert not report["ok"]
    assert any("'p0' has descriptors that do not match their checksum" in problem for problem in report["problems"])
    assert client.post("/v1/maps/sound/verify").json()["ok"]
    assert client.get("/v1/jobs").status_code == 200
    assert client.post("/v1/maps/sound/sessions", json={}).status_code == 201
    assert client.get("/v1/maps/sound/health").status_code == 200
    assert client.get("/v1/service/history").status_code == 200
    for name in DAMAGED_FILES:
        assert list(server.data_dir.glob(f"{name}.damaged*")), f"{name} is put aside, not deleted"
    assert DEFAULT_ENCODER in {one["name"] for one in client.get("/v1/encoders").json()["items"]}
    response = client.post("/v1/maps", json={"id": "new", "encoder": "broken"})
    assert response.status_code in (422, 503), response.text
    assert response.json()["type"].startswith("urn:placerec:problem:")
    assert client.delete("/v1/maps/damaged").status_code == 204
    server.create_map("damaged")
    assert server.enrol("damaged", "p0", jpeg(0)).status_code == 201


def test_a_frame_that_the_memory_does_not_suffice_for(server: Server, lab: str) -> None:
    """A limit on the address space of the process stands for a machine without memory."""
    process = server.process.pid
    limits = resource.prlimit(process, resource.RLIMIT_AS)
    used = int(Path(f"/proc/{process}/statm").read_text().split()[0]) * resource.getpagesize()
    frame_of_many_pixels = png(np.zeros((6000, 6500, 3), np.uint8))
    resource.prlimit(process, resource.RLIMIT_AS, (used, limits[1]))
    try:
        assert_problem(server.enrol("lab", "refused", frame_of_many_pixels), 503, "memory-full")
        assert server.client.get("/livez").status_code == 200
    finally:
        resource.prlimit(process, resource.RLIMIT_AS, limits)
    check_recovered(server)


@pytest.mark.thorough
def test_a_start_on_a_full_disk(tmp_path: Path) -> None:
    """It says so and ends with an error."""
    full = Server(tmp_path, wrapper=("/bin/sh", "-c", 'ulimit -f 0; exec "$@"', "sh"))
    try:
        status = full.process.wait(60)
    except Exception:
        full.process.send_signal(signal.SIGKILL)
        raise
    log = full.log_file.read_text()
    assert status not in (0, -signal.SIGXFSZ), log
    assert "Traceback" not in log
    full.client.close()
