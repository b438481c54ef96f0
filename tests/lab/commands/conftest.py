"""The laboratory's commands, run as the service's are; what they make is tried in a service."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.service.commands.conftest import monday, placerec
from tests.service.server import Server

__all__ = ["monday", "placerec", "server"]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    running = Server(tmp_path_factory.mktemp("service")).wait()
    yield running
    assert running.stop() == 0
