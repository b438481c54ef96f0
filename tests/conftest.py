"""What holds for all tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadFileScheduling

from tests.servers.postgres import Postgres, postgres_programs, running_postgres
from tests.servers.process import Missing

# Commands print what tests read, so that no variable of the machine may colour it; typer looks when it is imported.
for name in ("FORCE_COLOR", "PY_COLORS", "CLICOLOR_FORCE", "GITHUB_ACTIONS", "TTY_COMPATIBLE"):
    os.environ.pop(name, None)

# No test may depend on the speed of the machine or on what else it does.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")

PAGES, PROJECT = "tests/documents/test_commands.py", "tests/project/"
LONGEST = (
    PAGES,
    "tests/service/places/",
    "tests/service/commands/",
    "tests/service/console/",
    "tests/core/storage/files/test_failed_sync.py",
    "tests/service/sessions/test_sessions.py",
    "tests/service/upkeep/",
    "tests/lab/evaluation/report/",
    "tests/clients/",
    "tests/service/engine/",
    "tests/benchmarks/",
    "tests/lab/training/",
)
"""Files and folders whose tests take longest: they are begun first, so that no process is left with one at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first; tests of PostgreSQL are skipped where it is not installed."""
    if why := _why_no_postgres():
        for item in items:
            if item.get_closest_marker("postgres"):
                item.add_marker(pytest.mark.skip(reason=why))
    items.sort(key=lambda item: next((rank for rank, name in enumerate(LONGEST) if item.nodeid.startswith(name)), 99))


class Scheduling(LoadFileScheduling):  # type: ignore[misc]
    """The tests of one file stay together, for they share a server, and those of the project, which parse all files.

    The documents' pages are apart, for together they would take minutes.
    """

    def _split_scope(self, nodeid: str) -> str:
        if nodeid.startswith(PROJECT):
            return PROJECT
        return nodeid if nodeid.startswith(PAGES) else nodeid.partition("::")[0]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Scheduling:
    """One that begins with the longest files, not with those of most tests."""
    config.option.loadscopereorder = False
    return Scheduling(config, log)


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
