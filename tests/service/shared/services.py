"""Two services that share their state, on copies of one data directory.

What they share are sessions, keys and so on; the maps are copies, which stay the same as long as nobody changes them.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from service.peers.replica import FILE
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import jpeg
from tests.service.server import Server

MAP = "lab"
PLACES = 8


def prepare(folder: Path) -> None:
    """A data directory with a map of a few places."""
    install_coarse_encoder(folder / "models")
    server = Server(folder, settings={"encoder": COARSE}).wait()
    server.create_map(MAP)
    for number in range(PLACES):
        response = server.enrol(MAP, f"p{number}", jpeg(number), x=2 * number, y=0, sequence="monday")
        assert response.status_code == 201, response.text
    assert server.stop() == 0


@contextmanager
def two_services(
    prepared: Path, folder: Path, address: str, settings: Mapping[str, object], key: str | None = None
) -> Iterator[tuple[Server, Server]]:
    """Two services that run as long as the block, unless it kills them."""
    servers = []
    for name in ("one", "other"):
        shutil.copytree(prepared / "data", folder / name / "data")
        (folder / name / "data" / FILE).unlink(missing_ok=True)
        shutil.copytree(prepared / "models", folder / name / "models")
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
