"""Bad input at every door that takes a frame: the same problem, and a server that goes on."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable

import cv2
import httpx
import numpy as np
import pytest

from tests.service.scenes import encoded, jpeg, scene
from tests.service.server import Server, assert_problem

Send = Callable[[Server, str, bytes, dict[str, str]], httpx.Response]


def put(server: Server, map_id: str, data: bytes, headers: dict[str, str]) -> httpx.Response:
    return server.client.put(f"/v1/maps/{map_id}/places/p", content=data, headers=headers)


def query(server: Server, map_id: str, data: bytes, headers: dict[str, str]) -> httpx.Response:
    return server.client.post(f"/v1/maps/{map_id}/query", content=data, headers=headers)


def encode(server: Server, _map_id: str, data: bytes, headers: dict[str, str]) -> httpx.Response:
    return server.client.post("/v1/encode", content=data, headers=headers)


def regions(server: Server, _map_id: str, data: bytes, headers: dict[str, str]) -> httpx.Response:
    return server.client.post("/v1/regions", content=data, headers=headers)


DOORS = pytest.mark.parametrize("send", [put, query, encode, regions], ids=lambda send: send.__name__)


def png_header(width: int, height: int) -> bytes:
    """A PNG file of a few bytes that announces a picture of any size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    content = zlib.compress(b"\0" * 100_000)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", content) + chunk(b"IEND", b"")


GIF = b"GIF89a\x10\x00\x10\x00\x00\x00\x00;"
BMP = encoded(scene(1)[:32, :32], ".bmp")
BAD_FRAMES = {
    "empty": (b"", 422, "empty-image"),
    "text": (b"robots see rooms", 422, "not-an-image"),
    "html": (b"<!doctype html><html></html>", 422, "not-an-image"),
    "one byte": (b"\xff", 422, "not-an-image"),
    "truncated": (jpeg(1)[:-4000], 422, "truncated-image"),
    "first bytes": (jpeg(1)[:40], 422, "truncated-image"),
    "one pixel": (encoded(scene(1)[:1, :1]), 422, "image-too-small"),
    "narrow": (encoded(scene(1)[:, :15]), 422, "image-too-small"),
    "gif": (GIF, 415, "unsupported-format"),
    "bmp": (BMP, 415, "unsupported-format"),
}


@DOORS
@pytest.mark.parametrize("name", BAD_FRAMES)
def test_bad_frames(server: Server, map_id: str, send: Send, name: str) -> None:
    data, status, slug = BAD_FRAMES[name]
    assert_problem(send(server, map_id, data, {"Content-Type": "image/jpeg"}), status, slug)
    assert server.client.get(f"/v1/maps/{map_id}").json()["places"] == 0
    assert server.client.get("/livez").status_code == 200


@DOORS
@pytest.mark.parametrize("size", [(60_000, 60_000), (2**31 - 1, 2**31 - 1), (40_000_001, 16)])
def test_a_decompression_bomb_is_seen_from_its_header(
    server: Server, map_id: str, send: Send, size: tuple[int, int]
) -> None:
    response = send(server, map_id, png_header(*size), {"Content-Type": "image/png"})
    assert_problem(response, 413, "too-many-pixels")


def test_a_damaged_picture(server: Server, map_id: str) -> None:
    data = bytearray(encoded(scene(1), ".png"))
    data[len(data) // 2] ^= 0xFF
    response = put(server, map_id, bytes(data), {"Content-Type": "image/png"})
    assert response.status_code == 422
    assert response.json()["type"].rpartition(":")[2] in ("not-an-image", "truncated-image")


@DOORS
@pytest.mark.parametrize(
    "content_type",
    [None, "", "application/octet-stream", "image/gif", "text/plain", "application/json", "image/*", "multipart/mixed"],
)
def test_wrong_content_types(server: Server, map_id: str, send: Send, content_type: str | None) -> None:
    headers = {} if content_type is None else {"Content-Type": content_type}
    assert_problem(send(server, map_id, jpeg(1), headers), 415, "unsupported-media-type")


@pytest.mark.parametrize("extension", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("announced", ["image/jpeg", "image/png", "image/webp"])
def test_the_bytes_must_be_what_the_content_type_says(
    server: Server, map_id: str, extension: str, announced: str
) -> None:
    kind = {".jpg": "image/jpeg", ".png": "image/png", ".webp": "image/webp"}[extension]
    response = put(server, map_id, encoded(scene(1), extension), {"Content-Type": announced})
    if kind == announced:
        assert response.status_code == 201
    else:
        assert_problem(response, 415, "unsupported-media-type")


@pytest.mark.parametrize("content_type", ["IMAGE/JPEG", "image/jpeg; quality=high"])
def test_content_types_are_read_as_http_says(server: Server, map_id: str, content_type: str) -> None:
    assert put(server, map_id, jpeg(1), {"Content-Type": content_type}).status_code == 201


def test_parts_of_a_form_are_checked_alike(server: Server, map_id: str) -> None:
    path = f"/v1/maps/{map_id}/places/p"

    def send(data: bytes, content_type: str | None) -> httpx.Response:
        part = ("f", data) if content_type is None else ("f", data, content_type)
        return server.client.put(path, files={"image": part})

    assert_problem(send(jpeg(1), "image/png"), 415, "unsupported-media-type")
    assert_problem(send(jpeg(1), "image/gif"), 415, "unsupported-media-type")
    assert_problem(send(b"", "image/jpeg"), 422, "empty-image")
    assert_problem(send(jpeg(1)[:600], "image/jpeg"), 422, "truncated-image")
    assert send(jpeg(1), "application/octet-stream").status_code == 201, "the bytes decide"


def test_orientation_is_honoured_the_same_way(server: Server, map_id: str) -> None:
    """A frame turned by EXIF is the frame as seen, at enrolment and at query."""
    upright = encoded(scene(5), quality=95)
    turned = encoded(np.asarray(cv2.rotate(scene(5), cv2.ROTATE_90_COUNTERCLOCKWISE), np.uint8), quality=95)
    exif = b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">HHHIHHI", 1, 0x0112, 3, 1, 6, 0, 0)
    marked = turned[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + turned[2:]
    headers = {"Content-Type": "image/jpeg"}
    assert put(server, map_id, marked, headers).status_code == 201
    same = server.query(map_id, upright)["score"]
    assert same == pytest.approx(server.query(map_id, marked)["score"], rel=0.25)
    assert same > 3 * server.query(map_id, turned)["score"]


def test_colours_of_all_kinds_are_taken(server: Server, map_id: str) -> None:
    grey = encoded(np.asarray(cv2.cvtColor(scene(1), cv2.COLOR_BGR2GRAY), np.uint8), ".png")
    alpha = encoded(np.asarray(cv2.cvtColor(scene(1), cv2.COLOR_BGR2BGRA), np.uint8), ".png")
    deep = encoded(np.asarray(scene(1).astype(np.uint16) * 257, np.uint16), ".png")
    for data in (grey, alpha, deep):
        assert put(server, map_id, data, {"Content-Type": "image/png"}).status_code in (200, 201)
