"""A little of what ``scripts/soak`` does for hours: storage layer and service killed, and cut off from power."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from tests.durability.model import Lost
from tests.durability.server.kills import ServerKills
from tests.durability.server.processes import ServerProcesses
from tests.durability.storage import kill_points
from tests.durability.storage.driver import UNSYNCED
from tests.durability.storage.kills import WORKERS, StorageKills
from tests.durability.storage.power_cuts import power
from tests.durability.storage.processes import StorageProcesses
from tests.syscalls import strace

SEED = 1
POINTS_SEED = 783
"""The seed of a run that makes, imports, publishes, deletes, fills, empties, erases, closes and opens maps."""

needs_strace = pytest.mark.skipif(strace() is None, reason="strace is not installed, or may not trace here")


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StorageProcesses]:
    with StorageProcesses(tmp_path_factory.mktemp("processes"), WORKERS) as processes:
        yield processes


@pytest.mark.thorough
def test_storage_killed_at_random_moments_loses_nothing(tmp_path: Path, processes: StorageProcesses) -> None:
    tally = StorageKills(tmp_path, SEED).run(processes, 8)
    assert tally.kills == 8
    assert tally.operations > 40


@pytest.mark.thorough
@needs_strace
def test_storage_killed_at_calls_that_write_loses_nothing(tmp_path: Path, processes: StorageProcesses) -> None:
    every = kill_points.points(processes, tmp_path, POINTS_SEED)
    assert len(every) > 300 and {call for call, _ in every} >= {"fdatasync", "fsync", "ftruncate", "rename", "unlink"}
    met = [kill_points.kill_at(processes, tmp_path, POINTS_SEED, point)[0] for point in Random(SEED).sample(every, 4)]
    assert any(met)


@needs_strace
def test_storage_without_power_loses_nothing_that_was_acknowledged(tmp_path: Path, processes: StorageProcesses) -> None:
    tally = power(processes, tmp_path, SEED, 20, 12)
    assert tally.disks == 12
    assert tally.syncs > 20


@pytest.mark.thorough
@needs_strace
@pytest.mark.parametrize("unsynced", UNSYNCED)
def test_storage_that_does_not_sync_is_found_out(tmp_path: Path, unsynced: str) -> None:
    with StorageProcesses(tmp_path, unsynced=unsynced) as processes, pytest.raises(Lost, match="power cut"):
        power(processes, tmp_path, SEED, 10, 40)


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> ServerProcesses:
    return ServerProcesses(tmp_path_factory.mktemp("servers"))


@pytest.mark.thorough
def test_a_service_killed_while_clients_use_it_loses_nothing(
    tmp_path: Path, processes: StorageProcesses, servers: ServerProcesses
) -> None:
    tally = ServerKills(tmp_path, SEED).run(processes, servers, 2)
    assert tally.kills == 2
    assert tally.operations >= 10
