"""One real service for all tests of the client, and a new map for each."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest

from placerec_client import Client, Map
from tests.fuzz.encoder import install_small_encoder
from tests.service.server import Server

_numbers = itertools.count()


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The service with its default settings."""
    folder = tmp_path_factory.mktemp("client")
    install_small_encoder(folder / "models")
    running = Server(folder).wait()
    yield running
    assert running.stop() == 0


@pytest.fixture(scope="session")
def url(server: Server) -> str:
    return str(server.client.base_url)


@pytest.fixture
def client(server: Server, url: str) -> Iterator[Client]:
    server.check_running()
    with Client(url) as made:
        yield made


@pytest.fixture
def lab(client: Client) -> Map:
    """A new, empty map."""
    return client.maps.create(f"lab-{next(_numbers)}")


@pytest.fixture
def map_id(lab: Map) -> str:
    """The id of a new, empty map."""
    return lab.id
