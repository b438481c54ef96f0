"""A PostgreSQL and an object store for the tests of maps in them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.service.shared.postgres import Postgres, running_postgres

if TYPE_CHECKING:
    from core.postgres.pictures.bucket import Bucket


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    with running_postgres() as server:
        yield server


@pytest.fixture(scope="session")
def bucket(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bucket]:
    """A real object store's."""
    from tests.core.postgres.servers import running_object_store

    with running_object_store(tmp_path_factory.mktemp("objects")) as bucket:
        yield bucket
