from __future__ import annotations

from pathlib import Path

import pytest


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Without these tests, nothing that they import is imported."""
    return True if "not cluster" in str(config.getoption("markexpr")) else None


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the data of a service that has one map."""
    from tests.service.shared.services import prepare

    folder = tmp_path_factory.mktemp("prepared")
    prepare(folder)
    return folder
