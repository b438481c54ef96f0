from __future__ import annotations

from pathlib import Path

import pytest


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Without these tests, nothing that they import is imported."""
    return True if "not cluster" in str(config.getoption("markexpr")) else None
