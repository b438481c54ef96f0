"""A server that is strict about time and room, and logs in detail."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.service.server import Server

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


@pytest.fixture(scope="session")
def strict(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """The service with little patience."""
    running = Server(tmp_path_factory.mktemp("strict"), settings=STRICT).wait()
    yield running
    assert running.stop() == 0
