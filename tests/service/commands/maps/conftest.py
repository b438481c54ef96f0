"""The two modes of the commands on maps."""

from __future__ import annotations

import pytest

from tests.service.server import Server


@pytest.fixture(params=["here", "over HTTP"])
def where(request: pytest.FixtureRequest) -> list[str]:
    """The words that choose the mode."""
    if request.param == "here":
        return []
    running: Server = request.getfixturevalue("server")
    return ["--url", str(running.client.base_url)]
