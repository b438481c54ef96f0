"""One real server for all tests of the service, one with tight limits, and one with little patience."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import httpx
import pytest

from tests.servers.postgres import Postgres, running_postgres
from tests.service.encoders import install_coarse_encoder, install_two_stage_encoder
from tests.service.scenes import jpeg
from tests.service.server import Server

if TYPE_CHECKING:
    from service.shared.database import SharedDatabase

_numbers = itertools.count()

TIGHT: dict[str, int] = {
    "max_image_bytes": 60_000,
    "max_image_pixels": 400_000,
    "max_batch_items": 3,
    "max_batch_bytes": 150_000,
    "max_bulk_bytes": 1_000_000,
    "max_upload_memory": 500_000,
    "max_json_bytes": 4096,
    "max_metadata_bytes": 200,
    "queue_length": 1,
    "request_timeout": 5,
}

STRICT: dict[str, object] = {
    "head_timeout": 2,
    "read_timeout": 2,
    "write_timeout": 1,
    "keep_alive_timeout": 3,
    "storage_threads": 5,
    "max_connections": 400,
    "max_connections_per_address": 150,
    "max_pipelined": 8,
    "max_url_bytes": 2000,
    "max_header_bytes": 4000,
    "max_headers": 20,
    "max_stream_messages": 16,
    "max_stream_fragments": 32,
    "queue_length": 8,
    "max_maps": 8,
    "max_places": 3,
    "log_level": "debug",
}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--store",
        choices=("files", "postgres"),
        default="files",
        help="where the maps of the server of most tests are; postgres starts one",
    )


@contextmanager
def store_settings(kind: str) -> Iterator[dict[str, object]]:
    """The settings of a store, whose servers run as long as the block."""
    if kind == "files":
        yield {}
        return
    with running_postgres() as postgres:
        yield {"database": postgres.address}


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config) -> Iterator[Server]:
    """The service with its default settings, but for the store."""
    folder = tmp_path_factory.mktemp("server")
    install_coarse_encoder(folder / "models")
    install_two_stage_encoder(folder / "models")
    with store_settings(pytestconfig.getoption("--store", "embedded")) as settings:
        running = Server(folder, settings).wait()
        yield running
        assert running.stop() == 0


@pytest.fixture(scope="session")
def tight_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The service with limits that a test can reach."""
    running = Server(tmp_path_factory.mktemp("tight"), settings=TIGHT).wait()
    yield running
    assert running.stop() == 0


@pytest.fixture(scope="session")
def strict(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The service with little patience."""
    running = Server(tmp_path_factory.mktemp("strict"), settings=STRICT).wait()
    yield running
    assert running.stop() == 0


@pytest.fixture
def database(postgres: Postgres) -> Iterator[SharedDatabase]:
    """The ledger of services, with nothing in it."""
    from service.shared.database import SharedDatabase

    postgres.empty()
    database = SharedDatabase(postgres.address)
    yield database
    database.close()


@pytest.fixture
def client(server: Server) -> httpx.Client:
    """Talks to the server."""
    server.check_running()
    return server.client


@pytest.fixture
def map_id(server: Server) -> str:
    """A new, empty map."""
    server.check_running()
    name = f"map-{next(_numbers)}"
    server.create_map(name)
    return name


@pytest.fixture
def tight_map(tight_server: Server) -> str:
    """A new, empty map where limits are tight."""
    name = f"map-{next(_numbers)}"
    tight_server.create_map(name)
    return name


@pytest.fixture(scope="session")
def traverse(server: Server) -> str:
    """A map of eight places two metres apart; nobody changes it."""
    server.create_map("traverse")
    for number in range(8):
        response = server.enrol("traverse", f"p{number}", jpeg(number), x=2 * number, y=0, sequence="monday")
        assert response.status_code == 201, response.text
    return "traverse"


@pytest.fixture
def anyio_backend() -> str:
    """Asynchronous tests run on the event loop that the service runs on."""
    return "asyncio"
