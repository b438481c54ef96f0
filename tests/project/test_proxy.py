"""docker/tls.conf in a real nginx: keys, a query and a WebSocket through TLS, and what the log leaves out."""

from __future__ import annotations

import json
import shutil
import ssl
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
from websockets.sync.client import connect

from tests.certificates import certify
from tests.service.balancer import nginx_with
from tests.service.scenes import jpeg
from tests.service.server import ROOT, Server, free_port

pytestmark = pytest.mark.skipif(
    shutil.which("nginx") is None or shutil.which("openssl") is None, reason="nginx or openssl is not installed"
)


@dataclass
class Proxied:
    """A service behind nginx.  log: of nginx, of what was asked."""

    port: int
    server: Server
    trust: ssl.SSLContext
    log: Path
    key: str

    def client(self, key: str | None = None) -> httpx.Client:
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        return httpx.Client(base_url=f"https://localhost:{self.port}", verify=self.trust, headers=headers, timeout=60)


@pytest.fixture(scope="module")
def proxied(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxied]:
    folder = tmp_path_factory.mktemp("proxy")
    certify(folder)
    command = [sys.executable, "-m", "service.commands", "keys", "create", "op", "--role", "admin"]
    made = subprocess.run(
        [*command, "--data-dir", folder / "data"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("FORWARDED_ALLOW_IPS", "127.0.0.1")  # of nginx, as compose.tls.yaml names it
        server, port = Server(folder), free_port()
    changes = {
        "placerec:8000": f"127.0.0.1:{server.port}",
        "/etc/nginx/certificates": str(folder),
        "listen 443": f"listen 127.0.0.1:{port}",
    }
    try:
        with nginx_with("tls.conf", changes, folder, port) as log:
            server.wait()
            trust = ssl.create_default_context(cafile=str(folder / "authority.pem"))
            yield Proxied(port, server, trust, log, made.stdout.strip())
    finally:
        server.stop()


def test_a_key_is_requested_and_passed_on(proxied: Proxied) -> None:
    with proxied.client() as stranger:
        assert stranger.get("/readyz").status_code == 200
        refused = stranger.get("/v1/maps")
        assert (refused.status_code, refused.headers["www-authenticate"][:6]) == (401, "Bearer")
    with proxied.client(proxied.key) as operator:
        assert operator.post("/v1/maps", json={"id": "lab"}).status_code == 201
        kind = {"Content-Type": "image/jpeg"}
        enrolled = operator.put("/v1/maps/lab/places/p1?metadata={}", content=jpeg(1), headers=kind)
        assert enrolled.status_code == 201, enrolled.text
        answer = operator.post("/v1/maps/lab/query", content=jpeg(1), headers=kind).json()
        assert answer["matches"][0]["place"]["id"] == "p1"
        # Longer than nginx accepts by default but not than the service does, so the service refuses it.
        refused = operator.get(f"/v1/maps/lab/places?cursor={'x' * 60_000}")
        assert refused.headers["content-type"] == "application/problem+json"

        session = operator.post("/v1/maps/lab/sessions", json={}).json()["id"]
    address = f"wss://localhost:{proxied.port}/v1/maps/lab/sessions/{session}/stream"
    headers = {"Authorization": f"Bearer {proxied.key}"}
    with connect(address, ssl=proxied.trust, compression=None, additional_headers=headers) as stream:
        stream.send(json.dumps({"frame": 0}))
        stream.send(jpeg(1))
        assert json.loads(stream.recv(timeout=60))["single"]["matches"][0]["place"]["id"] == "p1"

    # The address in a client's own header is not believed; the one from nginx is.
    transport = httpx.HTTPTransport(verify=proxied.trust, local_address="127.0.0.9")
    forged = {"Authorization": headers["Authorization"], "X-Forwarded-For": "6.6.6.6"}
    with httpx.Client(transport=transport, base_url=f"https://localhost:{proxied.port}", headers=forged) as robot:
        assert robot.delete("/v1/maps/lab/places/p1").status_code == 204
    trail = proxied.server.lines_soon(logger="placerec.audit", operation="delete_place")
    assert [line["client"] for line in trail] == ["127.0.0.9"]

    logged = proxied.log.read_text()
    assert '"POST /v1/maps/lab/query" 200' in logged
    assert proxied.key not in logged and "metadata" not in logged
