"""``placerec maps export|import`` and ``placerec backup``: over HTTP, and on a data directory."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.core.store.archives.files import parts_of
from tests.service.commands.conftest import Placerec
from tests.service.scenes import jpeg
from tests.service.server import Server


@pytest.fixture(scope="module")
def lab(server: Server) -> str:
    """A map that nobody changes."""
    server.create_map("lab-to-save", keep="image")
    for number in range(3):
        assert server.enrol("lab-to-save", f"p{number}", jpeg(number), sequence="monday").status_code == 201
    return "lab-to-save"


@pytest.fixture
def url(server: Server) -> list[str]:
    return ["--url", str(server.client.base_url)]


@contextmanager
def service_with(maps: list[dict[str, object]]) -> Iterator[str]:
    """The address of a service that answers every GET with these maps: one that is not ours, and means no good."""

    class Listing(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = json.dumps({"items": maps, "quarantined": [], "next_cursor": None}).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Listing) as served:
        threading.Thread(target=served.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{served.server_address[1]}"
        finally:
            served.shutdown()


def damaged(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-3000] ^= 1
    path.write_bytes(content)


def test_a_map_as_a_file(placerec: Placerec, url: list[str], lab: str, tmp_path: Path, server: Server) -> None:
    file, partial = tmp_path / "lab.tar", tmp_path / "lab.tar.part"
    placerec("maps", "export", lab, file, *url)
    whole = file.read_bytes()
    assert not partial.exists() and "already" in placerec("maps", "export", lab, file, *url, status=1).stderr
    # Broken off somewhere: it goes on there. What does not fit is begun anew.
    for start in (whole[:200_000], whole, whole[:300], b"", b"something else".ljust(4000)):
        partial.write_bytes(start)
        placerec("maps", "export", lab, file, "--overwrite", *url)
        assert file.read_bytes() == whole and not partial.exists()
    before = server.lines(message="request", route="/v1/maps/{map}/export")[-5:]
    assert next(line["bytes_out"] for line in before if line["status"] == 206) == len(whole) - 200_000
    # Damaged on the way: never taken for good, and had whole at the next try.
    bent = bytearray(whole[:100_000])
    bent[50_000] ^= 1
    partial.write_bytes(bent)
    assert "damaged" in placerec("maps", "export", lab, file, "--overwrite", *url, status=1).stderr
    assert file.read_bytes() == whole and not partial.exists()
    placerec("maps", "export", lab, file, "--overwrite", *url)

    made = placerec("maps", "import", file, "--id", "lab-again", "--json", *url)
    assert json.loads(made.stdout)["result"]["places"] == 3
    assert "already" in placerec("maps", "import", file, "--id", "lab-again", *url, status=1).stderr
    damaged(file)
    assert "damaged" in placerec("maps", "import", file, "--id", "never", *url, status=1).stderr
    assert "--url" in placerec("maps", "import", file, "--no-wait", status=1).stderr


def test_a_file_is_of_one_moment_while_frames_are_enrolled(
    placerec: Placerec, url: list[str], server: Server, tmp_path: Path
) -> None:
    server.create_map("growing")
    assert server.enrol("growing", "p0", jpeg(0)).status_code == 201
    enough = threading.Event()
    enrolled: list[int] = []

    def enrol() -> None:
        while not enough.is_set():
            name = f"p{len(enrolled) + 1}"
            enrolled.append(server.enrol("growing", name, jpeg(len(enrolled) % 8)).status_code)

    thread = threading.Thread(target=enrol)
    thread.start()
    counts = []
    try:
        for attempt in range(3):
            file = tmp_path / f"{attempt}.tar"
            placerec("maps", "export", "growing", file, *url)
            manifest, parts = parts_of(file.read_bytes())
            lines = [json.loads(line) for line in parts["places-000001.jsonl"].splitlines()]
            assert [line["id"] for line in lines] == [f"p{n}" for n in range(manifest["places"])]
            counts.append(manifest["places"])
    finally:
        enough.set()
        thread.join()
    assert set(enrolled) == {201} and counts == sorted(counts) and counts[-1] <= len(enrolled) + 1


@pytest.mark.thorough
def test_backup_and_restore(
    placerec: Placerec, url: list[str], lab: str, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "backup"
    chosen = ["--map", lab, "--map", "hall-to-save"]
    server.create_map("hall-to-save", keep="image")
    assert server.enrol("hall-to-save", "p", jpeg(5)).status_code == 201
    placerec("backup", "create", folder, *chosen, *url)
    files = sorted(path.name for path in folder.glob("*.tar"))
    assert [name.partition(".")[0] for name in files] == ["hall-to-save", lab]
    # What has not changed is not written again; what has, is.
    times = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.tar")}
    assert server.enrol("hall-to-save", "q", jpeg(6)).status_code == 201
    told = placerec("backup", "create", folder, *chosen, *url).stderr
    assert f"{lab}: unchanged" in told and "hall-to-save: 2 places and looks in" in told
    now = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.tar")}
    assert len(now) == 2 and {name: at for name, at in now.items() if name in times} == {
        name: at for name, at in times.items() if name.startswith(lab)
    }
    # A damaged file is named, and written again although the map has not changed.
    (saved,) = folder.glob(f"{lab}.*.tar")
    damaged(saved)
    assert f"Damaged: {lab}" in placerec("backup", "verify", folder, status=1).stderr
    assert f"{lab}: 3 places and looks in" in placerec("backup", "create", folder, *chosen, *url).stderr
    placerec("backup", "verify", folder)
    # A map that is gone stays in the backup.
    assert server.client.delete("/v1/maps/hall-to-save").status_code == 204
    placerec("backup", "create", folder, "--map", lab, *url)
    index = {entry["id"]: entry for entry in json.loads((folder / "index.json").read_text())["maps"]}
    assert (index["hall-to-save"]["listed"], index[lab]["listed"]) == (False, True)
    assert "no longer in the service" in placerec("backup", "verify", folder).stdout

    # Into the data directory of another installation, where no service runs; maps there are left alone.
    told = placerec("backup", "restore", folder).stderr
    assert f"{lab}: 3 places" in told and "hall" not in told
    assert "already" in placerec("backup", "restore", folder, status=1).stderr
    placerec("backup", "restore", folder, "--map", "hall-to-save")
    # What was restored is what was saved, to the last bit.
    placerec("backup", "create", tmp_path / "second")
    second = {entry["id"]: entry for entry in json.loads((tmp_path / "second" / "index.json").read_text())["maps"]}
    assert {name: entry["manifest_sha256"] for name, entry in second.items()} == {
        name: entry["manifest_sha256"] for name, entry in index.items()
    }


def test_what_is_no_backup(placerec: Placerec, tmp_path: Path) -> None:
    assert "cannot be read" in placerec("backup", "verify", tmp_path / "none", status=1).stderr
    for name in ("2026-11-26T021500Z", "2026-11-27T021500Z"):  # as a service keeps them
        (tmp_path / "kept" / name).mkdir(parents=True)
        (tmp_path / "kept" / name / "index.json").write_text('{"format": "placerec backup", "version": 1, "maps": []}')
    for command in ("verify", "restore"):
        told = placerec("backup", command, tmp_path / "kept", status=1).stderr
        assert "holds 2 backups" in told and f"the latest is {tmp_path / 'kept' / '2026-11-27T021500Z'}" in told
    (tmp_path / "index.json").write_text('{"format": "placerec backup", "version": 2, "maps": []}')
    assert "later version" in placerec("backup", "verify", tmp_path, status=1).stderr
    entry = '{"id": "a", "file": "../../etc/passwd", "manifest_sha256": "00", "bytes": 1, "places": 1}'
    (tmp_path / "index.json").write_text(f'{{"format": "placerec backup", "version": 1, "maps": [{entry}]}}')
    assert "damaged" in placerec("backup", "verify", tmp_path, status=1).stderr


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["../evil", "/tmp/evil", "..", "a/b", "lab\n", "LAB", "", 7])
def test_a_service_chooses_no_file(placerec: Placerec, tmp_path: Path, name: object) -> None:
    """A backup of a service whose maps have names that lead out of the folder."""
    folder = tmp_path / "backup" / "folder"
    folder.mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    with service_with([{"id": name}]) as address:
        refused = placerec("backup", "create", folder, "--url", address, status=1)
    assert "no id of a map" in refused.stderr
    assert sorted(path for path in tmp_path.rglob("*") if path.name != "LOCK") == before


def test_no_map_takes_the_place_of_another_file_of_a_backup(
    placerec: Placerec, url: list[str], server: Server, tmp_path: Path
) -> None:
    """Maps whose names are those of the index and of another map's file."""
    server.create_map("plain")
    assert server.enrol("plain", "p", jpeg(0)).status_code == 201
    folder = tmp_path / "backup"
    placerec("backup", "create", folder, "--map", "plain", *url)
    (file,) = folder.glob("plain.*.tar")
    before = file.read_bytes()
    named = ["index.json", file.name]
    for name in named:
        server.create_map(name)
        placerec("backup", "create", folder, "--map", name, *url)
    assert file.read_bytes() == before
    placerec("backup", "verify", folder)
    index = json.loads((folder / "index.json").read_text())["maps"]
    assert {entry["id"] for entry in index} == {"plain", *named}
    assert {path.name for path in folder.iterdir()} == {"LOCK", "index.json", *(entry["file"] for entry in index)}
