"""Two services on one PostgreSQL, and a map of a few places in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import httpx

from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import jpeg
from tests.service.server import Server, assert_problem

MAP = "lab"
PLACES = 8


def fill(service: Server) -> None:
    """Make a map of a few places."""
    service.create_map(MAP)
    for number in range(PLACES):
        response = service.enrol(MAP, f"p{number}", jpeg(number), x=2 * number, y=0, sequence="monday")
        assert response.status_code == 201, response.text


def expect_away(response: httpx.Response) -> None:
    """A request is refused because PostgreSQL is away; a while after that has begun, nobody's key is known any more."""
    slug = "keys-unreadable" if "keys-unreadable" in response.text else "store-unavailable"
    detail = assert_problem(response, 503, slug)["detail"]
    assert "PostgreSQL" in detail or slug == "keys-unreadable"
    assert "127.0.0.1" not in detail and "port" not in detail, "callers here have no key of an admin"


@contextmanager
def two_services(
    folder: Path, address: str, settings: Mapping[str, object], key: str | None = None
) -> Iterator[tuple[Server, Server]]:
    """Two services that run as long as the block, unless it kills them."""
    servers = []
    for name in ("one", "other"):
        install_coarse_encoder(folder / name / "models")
        given = {"encoder": COARSE, "database": address, **settings}
        servers.append(Server(folder / name, settings=given, key=key))
    try:
        for server in servers:
            server.wait()
        yield servers[0], servers[1]
    finally:
        for server in servers:
            if server.process.poll() is None:
                server.stop()
