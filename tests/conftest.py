"""What holds for all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

from tests.servers.postgres import Postgres, postgres_programs, running_postgres
from tests.servers.process import Missing

# Commands print what tests read, so that no variable of the machine may colour it; typer looks when it is imported.
for name in ("FORCE_COLOR", "PY_COLORS", "CLICOLOR_FORCE", "GITHUB_ACTIONS", "TTY_COMPATIBLE"):
    os.environ.pop(name, None)

# No test may depend on the speed of the machine or on what else it does.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")

LONGEST = (
    "tests/core/store/test_failed_sync.py",
    "tests/service/upkeep/",
    "tests/service/places/",
    "tests/service/commands/",
    "tests/lab/evaluation/report/",
    "tests/lab/training/",
    "tests/service/console/",
    "tests/clients/",
    "tests/service/sessions/test_sessions.py",
    "tests/service/engine/",
    "tests/benchmarks/",
    "tests/fuzz/",
    "tests/core/cluster/",
    "tests/durability/",
)
"""Files and folders whose tests take longest: they are begun first, so that no process is left with one at the end.

Beside the first ones .ci/run checks types, so that those that wait for a browser or a robot come later.
"""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first; tests of PostgreSQL are skipped where it is not installed."""
    if why := _why_no_postgres():
        for item in items:
            if item.get_closest_marker("postgres"):
                item.add_marker(pytest.mark.skip(reason=why))
    items.sort(key=lambda item: next((rank for rank, name in enumerate(LONGEST) if item.nodeid.startswith(name)), 99))


def _why_no_postgres() -> str:
    """The reason why PostgreSQL cannot be started here; empty if it can."""
    try:
        postgres_programs()
    except Missing as missing:
        return str(missing)
    return ""


@pytest.fixture(scope="session")
def running_server() -> Iterator[Postgres]:
    with running_postgres() as postgres:
        yield postgres


@pytest.fixture(scope="module")
def postgres(running_server: Postgres) -> Postgres:
    """A real PostgreSQL, with nothing in it when a module's tests begin."""
    running_server.empty()
    return running_server
