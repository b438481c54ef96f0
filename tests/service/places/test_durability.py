"""Acknowledged writes are kept: after SIGKILL, on a full disk, and by the trace of the system calls."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.telemetry import history
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import encoded, jpeg, scene, seen_again
from tests.service.server import Server, assert_problem
from tests.service.wire import eventually
from tests.syscalls import audit, is_sqlite_index, is_success_response, strace, strace_arguments

TRAVERSE = 12


def answers(server: Server, map_id: str, frames: list[bytes]) -> list[dict[str, Any]]:
    """The answers to queries, without their times."""
    found = [server.query(map_id, frame, k=100) for frame in frames]
    for answer in found:
        del answer["milliseconds"]
    return found


@pytest.mark.thorough
def test_the_main_job(tmp_path: Path) -> None:
    """A traverse is enrolled, another localized, the process killed and started again: the same answers."""
    server = Server(tmp_path).wait()
    server.create_map("lab", description="main job")
    for number in range(TRAVERSE):
        stamp = f"2026-11-20T10:00:{number:02}Z"
        response = server.enrol(
            "lab", f"p{number:03}", jpeg(number), x=3 * number, y=0, heading=90, sequence="monday", timestamp=stamp
        )
        assert response.status_code == 201
    frames = [encoded(seen_again(scene(number), number)) for number in range(TRAVERSE)]
    frames += [jpeg(number) for number in range(200, 204)]
    before, places = answers(server, "lab", frames), server.places("lab")
    for number in range(TRAVERSE):
        assert before[number]["matches"][0]["place"]["id"] == f"p{number:03}"
    assert sum(answer["verdict"] == "recognized" for answer in before[:TRAVERSE]) >= TRAVERSE * 3 // 4

    server.kill()
    server = Server(tmp_path).wait()
    assert answers(server, "lab", frames) == before
    assert server.places("lab") == places
    assert server.client.post("/v1/maps/lab/verify").json()["ok"]
    assert server.stop() == 0


@pytest.mark.thorough
def test_the_corridor(tmp_path: Path) -> None:
    """The same with every third frame of a corridor and every sixth of its second traverse."""
    corridor = Path(__file__).parents[4] / "shared" / "datasets" / "eval" / "corridor"
    if not corridor.is_dir():
        pytest.skip("the corridor data set is not beside the repository")
    references = [path.read_bytes() for path in sorted((corridor / "ref").iterdir())][::3]
    queries = [path.read_bytes() for path in sorted((corridor / "query").iterdir())][::6]
    server = Server(tmp_path).wait()
    server.create_map("corridor")
    for number, data in enumerate(references):
        response = server.enrol("corridor", f"{number}", data, sequence="reference")
        assert response.status_code == 201
    before = answers(server, "corridor", queries)
    right = 0
    for number, answer in enumerate(before):
        right += abs(3 * int(answer["matches"][0]["place"]["id"]) - 6 * number) <= 3
    assert right / len(queries) > 0.5
    server.kill()
    server = Server(tmp_path).wait()
    assert answers(server, "corridor", queries) == before
    assert server.stop() == 0


@pytest.mark.thorough
def test_sigkill_during_enrolment_loses_nothing_acknowledged(tmp_path: Path) -> None:
    """One kill; tests/durability kills the service again after it has recovered."""
    frames = [jpeg(number) for number in range(6)]
    acknowledged: dict[str, int] = {}
    install_coarse_encoder(tmp_path / "models")
    coarse = {"encoder": COARSE}  # it encodes faster than the default encoder
    server = Server(tmp_path, coarse).wait()
    server.create_map("lab")

    def enrol(worker: int, url: httpx.URL) -> None:
        with httpx.Client(base_url=url, timeout=60) as client:
            for number in range(1000):
                name, frame = f"w{worker}-{number}", (worker + number) % len(frames)
                try:
                    response = client.put(
                        f"/v1/maps/lab/places/{name}?x={frame}&y=0",
                        content=frames[frame],
                        headers={"Content-Type": "image/jpeg"},
                    )
                except httpx.TransportError:
                    return
                assert response.status_code == 201
                acknowledged[name] = frame

    workers = [threading.Thread(target=enrol, args=(number, server.client.base_url)) for number in range(4)]
    for worker in workers:
        worker.start()
    until = time.monotonic() + 60
    while len(acknowledged) < 24 and time.monotonic() < until:
        time.sleep(0.01)
    server.kill()
    for worker in workers:
        worker.join(60)
    assert len(acknowledged) >= 24
    server = Server(tmp_path, coarse).wait()

    places = server.places("lab")
    assert set(acknowledged) <= set(places)
    assert all(places[name]["pose"] == {"x": float(frame), "y": 0.0} for name, frame in acknowledged.items())
    assert len(places) <= len(acknowledged) + 4, "besides there are at most the places of the requests in progress"
    report = server.client.post("/v1/maps/lab/verify").json()
    assert report["ok"], report
    for frame, data in enumerate(frames):
        alike = {name for name, place in places.items() if place["pose"]["x"] == frame}
        found = [match["place"]["id"] for match in server.query("lab", data, k=100)["matches"]]
        assert set(found[: len(alike)]) <= alike
    assert server.enrol("lab", "afterwards", frames[0]).status_code == 201
    assert server.stop() == 0


LIMITED = ("/bin/sh", "-c", 'ulimit -f 2048; exec "$@"', "sh")
"""No file of the process may grow past 2 MiB: a disk that is full as far as the service can tell."""


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own, of 24 MB."""
    mounted = tmp_path / "disk"
    mounted.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(mounted)], capture_output=True, check=False
    )
    if done.returncode != 0:
        pytest.skip("a small file system cannot be mounted here")
    yield mounted
    subprocess.run(["umount", "-l", str(mounted)], check=True)


def leave(disk: Path, left: int) -> None:
    """Have a file leave so many bytes free."""
    found = os.statvfs(disk)
    with (disk / "ballast").open("ab") as ballast:
        ballast.write(bytes(max(0, found.f_bavail * found.f_frsize - left)))


FULL, FAILED = (507, "storage-full"), (500, "storage-failure")
ROOM = 3 << 20
"""For a dozen frames, and the log of SQLite, which has them as well."""


def fill(server: Server, refusal: tuple[int, str] = FULL) -> dict[str, dict[str, Any]]:
    """Enrol until the disk is full; the acknowledged places."""
    for number in range(60):
        response = server.enrol("lab", f"p{number}", jpeg(number % 10), x=number, y=0)
        if response.status_code == refusal[0]:
            assert_problem(response, *refusal)
            return server.places("lab")
        assert response.status_code == 201, response.text
    raise AssertionError("the disk was never full")


def check_full_disk(server: Server, refusal: tuple[int, str] = FULL) -> dict[str, dict[str, Any]]:
    """A refusal for every write that needs room, nothing of it kept, and reads go on."""
    server.create_map("lab")
    kept = fill(server, refusal)
    assert len(kept) >= 3
    assert list(kept) == [f"p{number}" for number in range(len(kept))], "exactly the acknowledged ones"
    before = answers(server, "lab", [jpeg(1)])
    files = {f"f{number}": (f"f{number}", jpeg(20 + number), "image/jpeg") for number in range(12)}
    places = "[" + ",".join(f'{{"id": "b{number}", "file": "f{number}"}}' for number in range(12)) + "]"
    response = server.client.post("/v1/maps/lab/places", data={"places": places}, files=files)
    assert_problem(response, *refusal)
    assert server.places("lab") == kept
    assert answers(server, "lab", [jpeg(1)]) == before
    assert server.client.post("/v1/maps/lab/verify").json()["ok"]
    return kept


@pytest.mark.thorough
def test_a_full_disk_is_reported_and_nothing_is_half_written(tmp_path: Path) -> None:
    server = Server(tmp_path, wrapper=LIMITED).wait()
    kept = check_full_disk(server, FAILED)  # for which SQLite takes a file that may not grow
    server.kill()
    server = Server(tmp_path).wait()  # the disk has room again
    assert server.places("lab") == kept
    assert server.client.post("/v1/maps/lab/verify").json()["ok"]
    assert server.enrol("lab", "more", jpeg(50)).status_code == 201
    assert server.query("lab", jpeg(50))["matches"][0]["place"]["id"] == "more"
    assert server.stop() == 0


@pytest.mark.thorough
def test_a_full_file_system_is_reported_and_nothing_is_half_written(tmp_path: Path, small_disk: Path) -> None:
    server = Server(tmp_path, {"data_dir": small_disk / "data"}).wait()
    leave(small_disk, ROOM)
    kept = check_full_disk(server)
    for name in list(kept)[:2]:
        server.client.delete(f"/v1/maps/lab/places/{name}")  # may need room itself, may not
    assert server.client.get("/livez").status_code == 200
    server.kill()
    server = Server(tmp_path, {"data_dir": small_disk / "data"}).wait("/livez")
    assert set(server.places("lab")) <= set(kept)
    assert server.client.post("/v1/maps/lab/verify").json()["ok"]
    server.kill()


@pytest.mark.thorough
def test_what_is_deleted_on_a_full_file_system_makes_room(tmp_path: Path, small_disk: Path) -> None:
    """Not a byte is free, but for what the service holds back."""
    install_coarse_encoder(tmp_path / "models")
    settings = {"data_dir": small_disk / "data", "models_dir": tmp_path / "models", "encoder": COARSE}
    server = Server(tmp_path, settings | {"disk_reserve_bytes": 4 << 20}).wait()
    server.create_map("lab", keep="image")
    session = server.client.post("/v1/maps/lab/sessions", json={}).json()["id"]
    (small_disk / "other").write_bytes(bytes(1 << 20))
    leave(small_disk, ROOM)
    kept = list(fill(server))
    leave(small_disk, 0)
    assert os.statvfs(small_disk).f_bavail == 0
    assert server.enrol("lab", "refused", jpeg(11)).status_code == 507
    assert server.client.delete(f"/v1/maps/lab/sessions/{session}").status_code == 204
    for name in kept[:3]:
        response = server.client.delete(f"/v1/maps/lab/places/{name}")
        assert response.status_code == 204, response.text
    order = {"ids": kept[3:5], "dry_run": False}
    assert server.client.post("/v1/maps/lab/places:delete", json=order).json()["places"] == 2
    assert set(server.places("lab")) == set(kept[5:])
    (small_disk / "other").unlink()
    assert server.enrol("lab", "taken", jpeg(11)).status_code == 201
    assert server.client.post("/v1/maps/lab/verify").json()["ok"]
    assert server.stop() == 0


@pytest.mark.thorough
def test_a_service_on_a_full_file_system_answers_queries_even_if_it_starts_there(
    tmp_path: Path, small_disk: Path
) -> None:
    """Also from maps that nobody has opened before; writes are refused, and taken again as soon as there is room."""
    install_coarse_encoder(tmp_path / "models")
    settings = {"data_dir": small_disk / "data", "models_dir": tmp_path / "models", "encoder": COARSE}
    settings |= {"disk_reserve_bytes": 4 << 20, "statistics_seconds": 1}
    server = Server(tmp_path, settings).wait()
    for map_id in ("lab", "yard"):
        server.create_map(map_id)
        assert server.enrol(map_id, "p1", jpeg(1)).status_code == 201
    for _ in range(2):
        assert server.stop() == 0
        leave(small_disk, 0)
        server = Server(tmp_path, settings).wait()
        assert "The disk is full" in server.client.get("/readyz").json()["degraded"]
        for map_id in ("lab", "yard"):
            assert server.query(map_id, jpeg(1))["matches"][0]["place"]["id"] == "p1"
            for path in ("", "/places", "/answers", "/health", "/places/p1/matches", "/review"):
                assert server.client.get(f"/v1/maps/{map_id}{path}").status_code == 200, path
            assert_problem(server.enrol(map_id, "refused", jpeg(2)), 507, "storage-full")
        for path in ("/v1/maps", "/v1/fleet", "/v1/jobs", "/v1/service", "/v1/service/history", "/metrics"):
            assert server.client.get(path).status_code == 200, path
    (small_disk / "ballast").unlink()
    assert eventually(lambda: server.client.get("/readyz").json()["degraded"] is None, seconds=60)
    assert server.enrol("yard", "taken", jpeg(2)).status_code == 201
    assert set(server.places("yard")) == {"p1", "taken"}
    assert server.client.post("/v1/maps/yard/verify").json()["ok"]
    assert server.stop() == 0
    assert "Traceback" not in server.log_file.read_text()


def needs_no_sync(path: str) -> bool:
    """The history of the load is written when a minute ends, whatever is answered then, and may lose its last one."""
    return is_sqlite_index(path) or Path(path).name.startswith(history.FILE)


@pytest.mark.thorough
@pytest.mark.skipif(strace() is None, reason="strace is not installed, or may not trace here")
def test_a_2xx_is_sent_only_after_its_writes_are_synced(tmp_path: Path) -> None:
    trace, folder = tmp_path / "trace", tmp_path.resolve() / "server"
    server = Server(folder, wrapper=strace_arguments(trace)).wait()
    client = server.client
    server.create_map("lab", keep="image")
    writes = 1
    for number in range(4):
        assert server.enrol("lab", f"p{number}", jpeg(number), x=number, y=0, sequence="s").status_code == 201
    assert server.enrol("lab", "p0", jpeg(0), x=9, y=9).json()["change"] == "updated"
    assert server.enrol("lab", "p0", jpeg(5)).json()["change"] == "replaced"
    files = {"a": ("a", jpeg(6), "image/jpeg"), "b": ("b", b"bad", "image/jpeg")}
    batch = '[{"id": "b1", "file": "a"}, {"id": "b2", "file": "b"}]'
    assert client.post("/v1/maps/lab/places", data={"places": batch}, files=files).status_code == 200
    assert client.patch("/v1/maps/lab", json={"description": "x"}).status_code == 200
    assert client.patch("/v1/maps/lab/places/p1", json={"sequence": "t"}).status_code == 200
    assert client.delete("/v1/maps/lab/places/p2").status_code == 204
    assert client.delete("/v1/maps/lab/sequences/s").status_code == 200
    writes += 10
    server.create_map("gone")
    assert client.delete("/v1/maps/gone").status_code == 204
    writes += 2
    children = Path(f"/proc/{server.process.pid}/task/{server.process.pid}/children").read_text().split()
    for child in children:
        os.kill(int(child), signal.SIGKILL)
    server.process.wait(60)
    client.close()

    report = audit(trace.read_text(), server.data_dir, is_success_response, is_ignored=needs_no_sync)
    assert report.violations == []
    assert report.acknowledgements > writes
    assert report.syncs >= 2 * writes and report.writes >= writes
