"""The data directory of a service, which is for its user alone."""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.commands.conftest import Placerec, placerec
from tests.service.scenes import jpeg
from tests.service.server import Server

__all__ = ["placerec"]

OPEN = ("sh", "-c", 'umask 0; exec "$@"', "sh")
"""Starts a command whose files would be for everybody."""


def open_to_others(folder: Path) -> dict[str, str]:
    """Everything from a folder on that others than its user may use, by name."""
    found = {".": folder, **{str(path.relative_to(folder)): path for path in folder.rglob("*")}}
    return {
        name: stat.filemode(path.lstat().st_mode)
        for name, path in found.items()
        if stat.S_IMODE(path.lstat().st_mode) & 0o077
    }


@pytest.fixture
def without_umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


@pytest.mark.thorough
def test_nobody_else_reads_a_data_directory(tmp_path: Path) -> None:
    """While the service runs, with a map, its frames for review, an export and jobs; and when it has stopped."""
    audit = tmp_path / "audit.jsonl"
    server = Server(tmp_path, {"audit_file": audit}, wrapper=OPEN).wait()
    client = server.client
    server.create_map("lab", keep="image")
    for number in range(3):
        assert server.enrol("lab", f"p{number}", jpeg(number)).status_code == 201
    assert client.patch("/v1/maps/lab", json={"review": {"verdicts": None}}).status_code == 200
    assert client.post("/v1/maps/lab/query", content=jpeg(9), headers={"Content-Type": "image/jpeg"}).is_success
    exported = client.get("/v1/maps/lab/export")
    assert exported.status_code == 200
    job = client.post(
        "/v1/maps/import?id=again&background=true",
        content=exported.content,
        headers={"Content-Type": "application/x-tar"},
    ).json()
    until = time.monotonic() + 60
    while client.get(f"/v1/jobs/{job['id']}").json()["state"] in ("queued", "running"):
        assert time.monotonic() < until
    names = {path.name for path in server.data_dir.rglob("*")}
    assert names >= {"map.sqlite", "map.sqlite-wal", "map.sqlite-shm", "exports", "imports"}
    assert open_to_others(server.data_dir) == {} and stat.S_IMODE(audit.stat().st_mode) == 0o600
    assert server.stop() == 0
    assert open_to_others(server.data_dir) == {}


def test_a_data_directory_of_before_is_closed_at_the_start(
    tmp_path: Path, placerec: Placerec, without_umask: None
) -> None:
    directory = tmp_path / "data"
    placerec("maps", "create", "lab")
    for path in (directory, *directory.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)
    placerec("maps", "list")
    assert open_to_others(directory) == {}


def test_exports_and_backups_are_private(tmp_path: Path, placerec: Placerec, without_umask: None) -> None:
    placerec("maps", "create", "lab")
    placerec("maps", "export", "lab", tmp_path / "lab.tar")
    placerec("backup", "create", tmp_path / "backup")
    assert open_to_others(tmp_path / "backup") == {}
    assert stat.S_IMODE((tmp_path / "lab.tar").stat().st_mode) == 0o600
