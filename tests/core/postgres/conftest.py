"""An object store for the tests of maps in PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from core.postgres.pictures.bucket import Bucket


@pytest.fixture(scope="session")
def bucket(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bucket]:
    """A real object store's."""
    from tests.servers.object_store import running_object_store

    with running_object_store(tmp_path_factory.mktemp("objects")) as bucket:
        yield bucket
