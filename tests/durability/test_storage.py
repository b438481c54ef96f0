"""A little of what ``scripts/soak`` does for hours: the storage layer killed, and cut off from power."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from tests.durability import storage_points
from tests.durability.lives import Lives
from tests.durability.model import Lost
from tests.durability.storage_kills import WORKERS, StorageKills
from tests.durability.storage_power import power
from tests.syscalls import strace

SEED = 1

needs_strace = pytest.mark.skipif(strace() is None, reason="strace is not installed, or may not trace here")


@pytest.fixture(scope="module")
def lives(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lives]:
    with Lives(tmp_path_factory.mktemp("lives")) as lives:
        yield lives


def test_killed_at_random_moments_it_has_lost_nothing(tmp_path: Path) -> None:
    with Lives(tmp_path, WORKERS) as lives:
        tally = StorageKills(tmp_path, SEED).run(lives, 8)
    assert tally.kills == 8
    assert tally.operations > 40


@needs_strace
def test_killed_at_calls_that_write_it_has_lost_nothing(tmp_path: Path, lives: Lives) -> None:
    every = storage_points.points(lives, tmp_path, SEED)
    assert len(every) > 300
    met = [storage_points.kill_at(lives, tmp_path, SEED, point)[0] for point in Random(SEED).sample(every, 4)]
    assert any(met)


@needs_strace
def test_without_power_it_has_lost_nothing_that_was_acknowledged(tmp_path: Path, lives: Lives) -> None:
    tally = power(lives, tmp_path, SEED, 20, 12)
    assert tally.disks == 12
    assert tally.syncs > 20


@needs_strace
def test_a_storage_layer_that_does_not_sync_is_found_out(tmp_path: Path) -> None:
    with Lives(tmp_path, unsynced="descriptors") as lives, pytest.raises(Lost, match="power cut"):
        power(lives, tmp_path, SEED, 10, 40)
