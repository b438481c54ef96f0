"""Nothing that a caller sends but its path, its method and its ids is in the log, however much of it is logged."""

from __future__ import annotations

import json

import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from tests.service.scenes import jpeg
from tests.service.server import Server
from tests.service.wire import eventually, get, opened, rest

SECRET = "s3cr3t-that-nobody-may-read"
HEADERS = {"Authorization": f"Bearer {SECRET}", "Cookie": f"key={SECRET}", "X-Other": SECRET}


def test_keys_bodies_and_metadata_stay_out_of_the_log(strict: Server) -> None:
    strict.create_map("secrets", description=SECRET)
    frame, form = jpeg(2) + SECRET.encode(), {"image": (SECRET, SECRET.encode(), "image/jpeg")}
    image = {"Content-Type": "image/jpeg"}
    with httpx.Client(base_url=strict.client.base_url, headers=HEADERS, timeout=60) as client:
        metadata = {"metadata": json.dumps({"note": SECRET}), "sequence": SECRET}
        client.put("/v1/maps/secrets/places/p", params=metadata, content=frame, headers=image)
        client.put("/v1/maps/secrets/places/q", params=metadata, content=SECRET.encode() * 500, headers=image)
        client.put("/v1/maps/secrets/places/q", params={"x": SECRET, "y": SECRET}, content=frame, headers=image)
        client.patch("/v1/maps/secrets/places/p", json={"metadata": {"note": [SECRET]}})
        client.post("/v1/maps/secrets/query", params={"token": SECRET, "k": 1}, content=frame, headers=image)
        client.post("/v1/maps/secrets/query", params={"k": SECRET}, files=form)
        client.post("/v1/maps/secrets/places", data={"places": json.dumps([{"id": SECRET * 9}])}, files=form)
        client.post("/v1/maps", json={"id": "Not an id", "description": SECRET})
        client.post("/v1/maps", content=b'{"a": "' + SECRET.encode(), headers={"Content-Type": "application/json"})
        client.get("/v1/jobs", params={"cursor": SECRET})
        client.request(SECRET.upper()[:12], "/livez", params={"a": SECRET})
        client.get('/v1/maps/secrets/places%0d%0a{"level": "forged"}')
        client.get("/" + "long" * 400, headers={"X-Request-Id": "long-path"})
    address = f"ws://127.0.0.1:{strict.port}/v1/maps/secrets/sessions/s/stream?t={SECRET}"
    with pytest.raises(InvalidStatus):
        connect(address, additional_headers=HEADERS)
    connection = opened(strict)
    connection.sendall(b"GET /\x00" + SECRET.encode() + b" HTTP/1.1\r\n\r\n")
    rest(connection)
    last = opened(strict)
    last.sendall(get("/livez", "X-Request-Id: the-last-one", "Connection: close"))
    rest(last)
    assert eventually(lambda: bool(strict.lines(request_id="the-last-one")))
    text = strict.log_file.read_text()
    assert SECRET not in text and SECRET.upper()[:12] not in text
    assert not strict.lines(level="forged")
    (line,) = strict.lines(request_id="long-path", message="request")
    assert len(line["path"]) < 330 and line["path"].endswith("more)")
