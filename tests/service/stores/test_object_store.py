"""The service with its pictures in an object store, which is gone at the start and later."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from tests.servers.milvus import Servers
from tests.servers.object_store import SECRET
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem
from tests.service.stores.door import Door

pytestmark = [pytest.mark.cluster]


def pictures_state(service: Server, expected: str) -> None:
    """Wait until a ready service says this of its pictures."""
    until = time.monotonic() + 60
    while True:
        answer = service.client.get("/readyz")
        if answer.status_code == 200 and expected in answer.json()["checks"]["pictures"]:
            return
        assert time.monotonic() < until, answer.text
        time.sleep(0.2)


def test_queries_go_on_without_the_object_store(servers: Servers, tmp_path: Path) -> None:
    bucket = servers.bucket
    assert bucket.endpoint is not None
    door = Door(bucket.endpoint)
    install_coarse_encoder(tmp_path / "models")
    settings = {
        "vectors": "milvus", "milvus": servers.milvus_address, "database": servers.postgres_address, "encoder": COARSE,
        "objects": bucket.address, "objects_endpoint": door.address, "objects_access_key": bucket.access_key,
        "objects_secret_key": SECRET,
    }  # fmt: skip
    service = Server(tmp_path, settings).wait()
    shown, plain = "with-pictures", "without-pictures"
    service.create_map(shown, keep="thumbnail")
    service.create_map(plain, keep="none")

    pictures_state(service, "The object store cannot be reached")
    assert any("The object store is unavailable" in str(line) for line in service.lines(level="error"))
    refused = service.enrol(shown, "p1", jpeg(1))
    assert_problem(refused, 503, "store-unavailable")
    assert "object store" in refused.json()["detail"] and int(refused.headers["Retry-After"]) > 0
    assert service.places(shown) == {} and service.enrol(plain, "p1", jpeg(1)).status_code == 201
    assert service.query(plain, jpeg(1))["matches"][0]["place"]["id"] == "p1"

    door.open()
    pictures_state(service, "ok")
    assert service.enrol(shown, "p1", jpeg(1)).status_code == 201
    thumbnail = f"/v1/maps/{shown}/places/p1/thumbnail"
    before = service.client.get(thumbnail)
    assert before.status_code == 200

    door.shut()
    assert service.query(shown, jpeg(1))["matches"][0]["place"]["id"] == "p1"
    assert_problem(service.client.get(thumbnail), 503, "store-unavailable")
    pictures_state(service, "The object store cannot be reached")
    assert_problem(service.client.post(f"/v1/maps/{shown}/verify"), 503, "store-unavailable")
    assert list(service.places(shown)) == ["p1"]

    door.open()
    pictures_state(service, "ok")
    assert service.client.get(thumbnail).content == before.content
    assert service.client.post(f"/v1/maps/{shown}/verify").json()["ok"]
    for text in (service.client.get("/v1/service").text, service.log_file.read_text()):
        assert SECRET not in text
    for name in (shown, plain):
        assert service.client.delete(f"/v1/maps/{name}").status_code == 204
    assert service.stop() == 0
    door.shut()
