from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from service.shared.database import SharedDatabase
    from tests.service.shared.postgres import Postgres


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Without these tests, nothing that they import is imported."""
    return True if "not cluster" in str(config.getoption("markexpr")) else None


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A real PostgreSQL."""
    from tests.service.shared.postgres import running_postgres

    with running_postgres() as postgres:
        yield postgres


@pytest.fixture
def database(postgres: Postgres) -> Iterator[SharedDatabase]:
    """What services share, with nothing in it."""
    from service.shared.database import SharedDatabase

    postgres.empty()
    database = SharedDatabase(postgres.address)
    yield database
    database.close()


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the data of a service that has one map."""
    from tests.service.shared.services import prepare

    folder = tmp_path_factory.mktemp("prepared")
    prepare(folder)
    return folder
