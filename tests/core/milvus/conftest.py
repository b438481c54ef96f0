from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.servers.milvus import Servers


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Without these tests, nothing that they import is imported."""
    return True if "not cluster" in str(config.getoption("markexpr")) else None


@pytest.fixture(scope="session")
def servers() -> Iterator[Servers]:
    """A real PostgreSQL and a real Milvus."""
    from tests.servers.milvus import running_servers

    with running_servers() as servers:
        yield servers
