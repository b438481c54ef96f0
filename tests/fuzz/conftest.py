"""One server with a small encoder and limits that can be reached, for what is short enough for the suite."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.fuzz.api import TIGHT
from tests.fuzz.encoder import SMALL, install_small_encoder
from tests.service.server import Server


@pytest.fixture(scope="package")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A running service."""
    folder = tmp_path_factory.mktemp("fuzzed")
    install_small_encoder(folder / "models")
    server = Server(folder, {**TIGHT, "encoder": SMALL}).wait()
    yield server
    server.check_running()
    assert server.stop() == 0
    log = server.log_file.read_text()
    assert "Traceback" not in log, log[-4000:]
