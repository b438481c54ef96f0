"""Bodies that are compressed, or have another digest than the request states, are refused before anything is stored."""

from __future__ import annotations

import base64
import hashlib
import json

import pytest

from service.errors.faults import DigestMismatch, InvalidRequest
from service.http.digests import StatedDigests
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem

JPEG = {"Content-Type": "image/jpeg"}


def stated(data: bytes, algorithm: str = "sha-256") -> str:
    digest = hashlib.new(algorithm.replace("-", ""), data).digest()
    return f"{algorithm}=:{base64.b64encode(digest).decode()}:"


def checked(value: str, data: bytes = b"abc") -> None:
    digests = StatedDigests()
    digests.expect("Content-Digest", value)
    for at in range(len(data)):
        digests.add(data[at : at + 1])
    digests.check()


def test_what_is_stated_is_compared() -> None:
    right, wrong = stated(b"abc"), stated(b"abd")
    for value in ("", right, stated(b"abc", "sha-512"), f"{right}, {stated(b'abc', 'sha-512')}", f"md5=:AA==:,{right}",
                  "crc32c=:AAAAAA==:", f" {right};a=1 "):  # fmt: skip
        checked(value)
    for value in (wrong, f"{right}, {stated(b'abd', 'sha-512')}", f"{wrong},{right}", "sha-512=:AA==:"):
        with pytest.raises(DigestMismatch, match="Content-Digest"):
            checked(value)


@pytest.mark.parametrize("value", ["abc", "sha-256", "sha-256=abc", "sha-256=:abc:", "sha-256=:AA==", "sha-256=:A A=:"])
def test_what_is_malformed_is_refused(value: str) -> None:
    with pytest.raises(InvalidRequest, match="Content-Digest"):
        checked(value)


@pytest.mark.parametrize(
    ("header", "value", "status", "slug"),
    [
        ("Content-Digest", stated(b"another frame"), 422, "digest-mismatch"),
        ("Content-Digest", stated(b"another frame", "sha-512"), 422, "digest-mismatch"),
        ("Repr-Digest", stated(b"another frame"), 422, "digest-mismatch"),
        ("Content-Digest", "sha-256=abc", 422, "invalid-request"),
        ("Content-Encoding", "gzip", 415, "unsupported-media-type"),
        ("Content-Encoding", "identity, br", 415, "unsupported-media-type"),
    ],
)
def test_nothing_is_stored(server: Server, map_id: str, header: str, value: str, status: int, slug: str) -> None:
    more = {header: value}
    places = json.dumps([{"id": "p", "file": "a"}])
    for background in ("false", "true"):
        sent = server.client.post(
            f"/v1/maps/{map_id}/places", params={"background": background}, data={"places": places},
            files={"a": ("a.jpg", jpeg(1), "image/jpeg")}, headers=more,
        )  # fmt: skip
        assert_problem(sent, status, slug)
    put = server.client.put(f"/v1/maps/{map_id}/places/p", content=jpeg(1), headers=JPEG | more)
    if status == 415:
        assert repr(value.split()[-1]) in assert_problem(put, status, slug)["detail"]
        assert put.headers["accept-encoding"] == "identity"
    assert_problem(put, status, slug)
    assert_problem(server.client.post("/v1/maps", json={"id": "never-made"}, headers=more), status, slug)
    assert server.places(map_id) == {} and server.client.get("/v1/maps/never-made").status_code == 404


def test_what_is_right_is_stored(server: Server, map_id: str) -> None:
    frame = jpeg(1)
    for headers in (
        {"Content-Digest": stated(frame)},
        {"Content-Digest": f"{stated(frame, 'sha-512')}, unixsum=:AA==:"},
        {"Content-Encoding": "identity"},
        {"Content-Type": "image/jpg"},
        {"Content-Type": "image/pjpeg"},
    ):
        sent = server.client.put(f"/v1/maps/{map_id}/places/p", content=frame, headers=JPEG | headers)
        assert sent.status_code in (200, 201), sent.text
    form = server.client.put(f"/v1/maps/{map_id}/places/q", files={"image": ("q.jpg", frame, "image/jpg")})
    assert form.status_code == 201


def test_of_a_piece_of_a_bag_that_has_another_digest_nothing_stays(server: Server, map_id: str) -> None:
    path, first, second = f"/v1/maps/{map_id}/recordings/walk.mcap", b"a" * 3_000_000, b"b" * 3_000_000
    octets = {"Content-Type": "application/octet-stream"}

    def piece(offset: int, data: bytes, said: bytes) -> int:
        headers = octets | {"Content-Digest": stated(said), "Repr-Digest": stated(first + second)}  # of the whole file
        return server.client.put(path, params={"offset": offset}, content=data, headers=headers).status_code

    assert piece(0, first, second) == 422 and server.client.get(path).json()["bytes"] == 0
    assert piece(0, first, first) == 200
    assert piece(len(first), second, first) == 422 and server.client.get(path).json()["bytes"] == len(first)
    assert piece(len(first), second, second) == 200
    assert server.client.get(path).json()["bytes"] == len(first + second)
