"""Exports and imports over HTTP: interrupted downloads continue, and an import makes a complete map or none."""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import socket
import tempfile
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from core.maps.archives.manifest import group_names
from core.maps.archives.reading import Archive, check
from tests.core.store.archives.files import Parts, changed, line_changed, named, parts_of, sealed
from tests.service.encoders import install_coarse_encoder
from tests.service.map_jobs import wait_until
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem

TAR = {"Content-Type": "application/x-tar"}
_ids = itertools.count()


def new_id() -> str:
    return f"imported-{next(_ids)}"


def export(server: Server, map_id: str, **headers: str) -> httpx.Response:
    sent = {name.replace("_", "-"): value for name, value in headers.items()}
    return server.client.get(f"/v1/maps/{map_id}/export", headers=sent)


def import_file(server: Server, content: bytes, map_id: str | None = None, **params: str) -> httpx.Response:
    sent = {**params, **({} if map_id is None else {"id": map_id})}
    return server.client.post("/v1/maps/import", params=sent, content=content, headers=TAR)


def places(server: Server, map_id: str) -> list[Any]:
    items: list[Any] = server.client.get(f"/v1/maps/{map_id}/places", params={"limit": 1000}).json()["items"]
    return items


def staged(server: Server) -> list[str]:
    """The files of imports, and the unlisted maps."""
    found = [*server.data_dir.glob("imports/*"), *server.data_dir.glob("imports/.*"), *server.data_dir.glob("maps/.*")]
    return [path.name for path in found]


@pytest.fixture(scope="module")
def source(server: Server) -> str:
    """A map that keeps images; no test changes it."""
    server.create_map("to-move", keep="image", description="three rooms")
    assert server.client.put("/v1/maps/to-move/cameras/front", json={"mask": None}).status_code in (200, 201)
    for number in range(3):
        place = {"x": number, "y": 0, "sequence": "monday", "metadata": {"n": number}, "camera": "front"}
        assert server.enrol("to-move", f"p{number}", jpeg(number), **place).status_code == 201
    return "to-move"


@pytest.fixture(scope="module")
def content(server: Server, source: str) -> bytes:
    """The export file of the map."""
    return export(server, source).content


def test_a_map_comes_back_under_another_id(server: Server, source: str, content: bytes) -> None:
    name = new_id()
    made = import_file(server, content, name)
    assert made.status_code == 201 and made.headers["location"] == f"/v1/maps/{name}"
    ours, theirs = (server.client.get(f"/v1/maps/{map_id}") for map_id in (source, name))
    assert theirs.headers["etag"] == made.headers["etag"]
    changing = {"id", "index", "storage"}
    assert {**ours.json(), **dict.fromkeys(changing)} == {**theirs.json(), **dict.fromkeys(changing)}
    assert places(server, name) == places(server, source)
    answers = [server.query(map_id, jpeg(1)) for map_id in (source, name)]
    for answer in answers:
        for field in ("milliseconds", "request_id", "map"):
            answer.pop(field, None)
    assert answers[0] == answers[1] and answers[0]["matches"][0]["place"]["id"] == "p1"
    assert server.client.post(f"/v1/maps/{name}/verify").json()["ok"]
    assert server.enrol(name, "next", jpeg(7)).status_code == 201
    assert staged(server) == []


def test_a_download_shows_the_map_as_it_was_when_it_began(server: Server, content: bytes) -> None:
    name = new_id()
    assert import_file(server, content, name).status_code == 201
    first = export(server, name)
    tag, size = first.headers["etag"], int(first.headers["content-length"])
    assert first.status_code == 200 and len(first.content) == size and first.headers["accept-ranges"] == "bytes"
    manifest = parts_of(first.content)[0]
    assert tag.strip('"') == hashlib.sha256(first.content[512 : 512 + _size(first.content)]).hexdigest()
    assert manifest["map"]["id"] == name
    head = server.client.head(f"/v1/maps/{name}/export", headers={"Range": "bytes=5-"})
    assert head.status_code == 200 and head.content == b""
    assert (head.headers["etag"], head.headers["content-length"]) == (tag, str(size))
    assert export(server, name, if_none_match=tag).status_code == 304
    # The map is changed and then deleted: the rest of the download is not affected.
    assert server.enrol(name, "later", jpeg(8)).status_code == 201
    part = export(server, name, range="bytes=1000-1999", if_range=tag)
    assert part.status_code == 206 and part.headers["content-range"] == f"bytes 1000-1999/{size}"
    assert part.content == first.content[1000:2000] and part.headers["content-length"] == "1000"
    now = export(server, name, if_none_match=tag)
    assert now.status_code == 200 and now.headers["etag"] != tag
    assert server.client.delete(f"/v1/maps/{name}").status_code == 204
    rest = export(server, name, range=f"bytes={size - 700}-", if_match=tag)
    assert rest.status_code == 206 and rest.content == first.content[-700:]
    behind = export(server, name, range=f"bytes={size}-", if_range=tag)
    assert behind.headers["content-range"] == f"bytes */{size}"
    assert_problem(behind, 416, "range-not-satisfiable")
    assert_problem(export(server, name), 404, "unknown-map")
    assert_problem(export(server, name, if_match='"other"'), 404, "unknown-map")


def _size(content: bytes) -> int:
    return int(content[124:135], 8)


def test_an_export_that_is_not_stored(server: Server, source: str) -> None:
    assert_problem(export(server, source, range="bytes=5-", if_match='"0123"'), 412, "export-gone")
    whole = export(server, source, range="bytes=5-", if_range='"0123"')
    assert whole.status_code == 200 and len(whole.content) == int(whole.headers["content-length"])


def test_taken_ids(server: Server, source: str, content: bytes) -> None:
    assert_problem(import_file(server, content), 409, "map-exists")
    assert_problem(import_file(server, content, source), 409, "map-exists")
    assert_problem(import_file(server, content, "../x"), 422, "invalid-identifier")
    assert_problem(import_file(server, content, "import"), 422, "invalid-identifier")
    assert staged(server) == []


def test_encoders(server: Server, content: bytes) -> None:
    name = new_id()

    def elsewhere(manifest: dict[str, Any], _parts: Parts) -> None:
        manifest["map"]["encoder"] = "m-region-vlad@" + "0" * 64

    problem = assert_problem(import_file(server, changed(content, elsewhere), name), 409, "wrong-encoder")
    assert "not installed" in problem["detail"]
    assert_problem(import_file(server, content, name, encoder="coarse"), 409, "wrong-encoder")

    def reshaped(manifest: dict[str, Any], parts: Parts) -> None:
        manifest["map"]["dimension"] //= 2

    assert_problem(import_file(server, changed(content, reshaped), name), 422, "invalid-archive")
    assert import_file(server, content, name, encoder="m-region-vlad").status_code == 201


def _no_picture(manifest: dict[str, Any], parts: Parts) -> None:
    (line, *rest) = parts["places-000001.jsonl"].splitlines(keepends=True)
    value = json.loads(line)
    data = b"<script>".ljust(value["picture"]["bytes"])
    value["picture"]["sha256"] = hashlib.sha256(data).hexdigest()
    parts["places-000001.jsonl"] = json.dumps(value).encode() + b"\n" + b"".join(rest)
    parts["pictures-000001.bin"] = data + parts["pictures-000001.bin"][len(data) :]


def _endless_picture(manifest: dict[str, Any], parts: Parts) -> None:
    """A PNG of 900 megapixels, by its header."""
    (line, *rest) = parts["places-000001.jsonl"].splitlines(keepends=True)
    value = json.loads(line)
    old = value["picture"]["bytes"]
    data = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR" + (30_000).to_bytes(4, "big") * 2 + bytes(9)
    value["picture"] |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    parts["places-000001.jsonl"] = json.dumps(value).encode() + b"\n" + b"".join(rest)
    parts["pictures-000001.bin"] = data + parts["pictures-000001.bin"][old:]


def test_hostile_files(server: Server, content: bytes) -> None:
    """One of each kind; ``tests/core/store/archives`` has them all."""
    manifest, parts = parts_of(content)
    for made, slug in (
        (b"", "invalid-archive"),
        (jpeg(1), "invalid-archive"),
        (content[:-600], "invalid-archive"),
        (content + content, "invalid-archive"),
        (content[:-5000] + b"x" + content[-4999:], "invalid-archive"),
        (line_changed(content, "places-000001.jsonl", 1, id="../p"), "invalid-archive"),
        (changed(content, _no_picture), "invalid-archive"),
        (changed(content, _endless_picture), "invalid-archive"),
        (named(json.dumps({**manifest, "version": 9}).encode(), parts), "archive-too-new"),
    ):
        name = new_id()
        assert_problem(import_file(server, made, name), 422, slug)
        assert_problem(server.client.get(f"/v1/maps/{name}"), 404, "unknown-map")
        assert staged(server) == []
    text = server.client.post("/v1/maps/import", content=content, headers={"Content-Type": "text/plain"})
    assert_problem(text, 415, "unsupported-media-type")


@pytest.mark.parametrize("factor", [0.5, 1.1, 4.0])
def test_descriptors_of_another_length_are_refused(server: Server, content: bytes, factor: float) -> None:
    """A place whose descriptor is four times as long would be more like every frame than any other place."""

    def lengthen(manifest: dict[str, Any], parts: Parts) -> None:
        _, name, *_ = group_names(0)
        width, dimension = len(parts[name]) // manifest["places"], manifest["map"]["dimension"]
        rows = np.frombuffer(parts[name], np.uint8).reshape(-1, width).copy()
        last = rows[-1, : 2 * dimension].view("<f2")
        last[:] = (last.astype(np.float32) * factor).astype("<f2")
        parts[name] = rows.tobytes()

    refused = import_file(server, changed(content, lengthen), new_id())
    assert "has a length that its encoder gives to none" in assert_problem(refused, 422, "invalid-archive")["detail"]


def test_digests(server: Server, content: bytes) -> None:
    right = base64.b64encode(hashlib.sha256(content).digest()).decode()
    wrong = base64.b64encode(bytes(32)).decode()
    name = new_id()
    for header, value, status, slug in (
        ("Content-Digest", f"sha-256=:{wrong}:", 422, "digest-mismatch"),
        ("Repr-Digest", f"md5=:abcd:, sha-256=:{wrong}:", 422, "digest-mismatch"),
        ("Repr-Digest", right, 422, "invalid-request"),
    ):
        sent = server.client.post(
            "/v1/maps/import", params={"id": name}, content=content, headers={**TAR, header: value}
        )
        assert_problem(sent, status, slug)
    headers = {**TAR, "Content-Digest": f"sha-256=:{right}:", "Repr-Digest": f"sha-1=:AA==:,sha-256=:{right}:"}
    sent = server.client.post("/v1/maps/import", params={"id": name}, content=content, headers=headers)
    assert sent.status_code == 201


def begun(server: Server, target: str, announced: int, first: bytes) -> socket.socket:
    """A connection on which only the beginning of a request was sent."""
    connection = socket.create_connection(("127.0.0.1", server.port), timeout=20)
    head = f"POST {target} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/x-tar\r\n"
    connection.sendall(f"{head}Content-Length: {announced}\r\n\r\n".encode() + first)
    return connection


@pytest.mark.parametrize(
    ("query", "announced", "status"),
    [
        ("id=to-move", 1 << 24, b"409"),  # seen before anything of the body is read
        ("id=never-moved", 1 << 40, b"413"),
        ("id=never-moved", 1 << 24, b"422"),  # seen when the manifest has come: the file is not that long
        ("id=never-moved&encoder=coarse", 0, b"409"),
    ],
)
def test_an_import_is_refused_before_the_rest_is_sent(
    server: Server, content: bytes, query: str, announced: int, status: bytes
) -> None:
    """All but the last byte is sent, or as much more as the server gathers before it looks at it."""
    first = content[:-1] if not announced else content + bytes((2 << 20) - len(content))
    with begun(server, f"/v1/maps/import?{query}", announced or len(content), first) as connection:
        if announced:
            assert connection.recv(100).startswith(b"HTTP/1.1 " + status)
        else:  # a short file is looked at when it ends
            connection.sendall(content[-1:])
            assert connection.recv(100).startswith(b"HTTP/1.1 " + status)
    assert _settled(server) == []


def _settled(server: Server) -> list[str]:
    """What is left after a while."""
    until = time.monotonic() + 60
    while (left := staged(server)) and time.monotonic() < until:
        time.sleep(0.02)
    return left


def test_an_upload_that_breaks_off_leaves_nothing(server: Server, content: bytes) -> None:
    name = new_id()
    begun(server, f"/v1/maps/import?id={name}", len(content), content[: len(content) // 2]).close()
    assert _settled(server) == []
    assert_problem(server.client.get(f"/v1/maps/{name}"), 404, "unknown-map")


def test_as_a_job(server: Server, source: str, content: bytes) -> None:
    name = new_id()
    asked = import_file(server, content, name, background="true")
    assert asked.status_code == 202 and asked.headers["location"] == f"/v1/jobs/{asked.json()['id']}"
    done = server.client.get(f"{asked.headers['location']}?wait=30").json()
    assert done["state"] == "succeeded" and done["result"]["places"] == 3, done
    assert done["progress"]["done"] == done["progress"]["total"] == 3
    assert places(server, name) == places(server, source)
    bad = import_file(server, line_changed(content, "places-000001.jsonl", 1, regions=-1), new_id(), background="true")
    failed = server.client.get(f"{bad.headers['location']}?wait=30").json()
    assert failed["state"] == "failed" and failed["problem"]["type"] == "urn:placerec:problem:invalid-archive"
    assert_problem(import_file(server, content, name, background="true"), 409, "map-exists")
    wait_until(lambda: staged(server) == [])


MANY = 8_000


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a service that is killed."""
    folder = tmp_path_factory.mktemp("apart")
    install_coarse_encoder(folder / "models")
    return folder


def large(server: Server) -> bytes:
    """The export file of a map of many places of the coarse encoder, with random descriptors."""
    server.create_map("seed", encoder="coarse", keep="none")
    assert server.enrol("seed", "p", jpeg(1)).status_code == 201
    manifest, parts = parts_of(export(server, "seed").content)
    assert server.client.delete("/v1/maps/seed").status_code == 204
    line, width = json.loads(parts["places-000001.jsonl"]), len(parts["descriptors-000001.bin"])
    length = np.linalg.norm(np.frombuffer(parts["descriptors-000001.bin"], "<f2").astype(np.float64))
    random = np.random.default_rng(1)
    made: Parts = {name: parts[name] for name in ("sequences.jsonl", "cameras.jsonl")}
    made["sequences.jsonl"] = json.dumps({"name": None, "next_ordinal": MANY}).encode() + b"\n"
    listed = manifest["parts"][:2]
    for group, first in enumerate(range(0, MANY, 1000)):
        lines = [
            json.dumps({**line, "id": f"p{n}", "ordinal": n, "keypoints": None}) + "\n"
            for n in range(first, first + 1000)
        ]
        drawn = random.standard_normal((1000, width // 2))
        halves = (length * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)).astype("<f2")
        for name, data in zip(group_names(group), ("".join(lines).encode(), halves.tobytes(), b"", b""), strict=True):
            made[name] = data
            listed.append({"name": name, "rows": 1000})
    return sealed({**manifest, "places": MANY, "parts": listed}, made)


@pytest.mark.thorough
def test_killed_at_every_stage(apart: Path) -> None:
    """Killed while a file arrives, a request makes a map and a job another: no map is incomplete, the job continues."""
    settings = {"max_imports": 3, "max_import_bytes": 1 << 28}
    server = Server(apart, settings).wait()
    content = large(server)
    with begun(server, "/v1/maps/import", 1 << 29, b"") as connection:
        assert connection.recv(100).startswith(b"HTTP/1.1 413")
    job = import_file(server, content, "by-job", background="true").headers["location"]
    making = begun(server, "/v1/maps/import?id=by-request", len(content), content)
    wait_until(lambda: any(server.data_dir.glob("maps/.making-by-request-*/map.sqlite-wal")))
    arriving = begun(server, "/v1/maps/import?id=arriving", len(content), content[: len(content) // 2])
    wait_until(lambda: any(server.data_dir.glob("imports/.*")))
    wait_until(lambda: server.client.get(job).json()["progress"]["done"] > 200)
    assert server.client.get("/v1/maps").json()["items"] == []
    assert_problem(server.client.post("/v1/maps", json={"id": "by-request"}), 409, "map-exists")
    second = import_file(server, content, "second")
    assert "retry-after" in second.headers
    assert_problem(second, 503, "too-many-imports")
    server.kill()
    for connection in (making, arriving):
        connection.close()
    assert any(server.data_dir.glob("exports/*.tar"))
    server = Server(apart).wait()
    assert not (server.data_dir / "exports").exists()
    assert (
        server.client.get("/v1/maps/by-request").status_code
        == server.client.get("/v1/maps/arriving").status_code
        == 404
    )
    done = server.client.get(f"{job}?wait=60").json()
    assert done["state"] == "succeeded" and done["attempt"] == 2 and done["result"]["places"] == MANY, done
    assert server.client.get("/v1/maps/by-job").json()["places"] == MANY
    # Cancelled, nothing is left.
    other = import_file(server, content, "other", background="true").headers["location"]
    wait_until(lambda: server.client.get(other).json()["progress"]["done"] > 200)
    assert server.client.post(f"{other}/cancel").status_code == 200
    assert server.client.get(f"{other}?wait=30").json()["state"] == "cancelled"
    wait_until(lambda: staged(server) == [])
    assert server.client.get("/v1/maps/other").status_code == 404
    with tempfile.NamedTemporaryFile() as file:
        file.write(export(server, "by-job").content)
        file.flush()
        with Archive(Path(file.name)) as archive:
            check(archive)
    assert server.stop() == 0
    assert not (apart / "data" / "exports").exists()
