"""Damaged small files beside the maps, and damaged exports, are put aside or refused and end in no crash."""

from __future__ import annotations

import os
import random
import secrets
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from core.disk.files import Damage
from core.errors import ArchiveTooNew, DataDirectoryTooNew, InvalidArchive, StorageFailure, StorageFull
from core.maps.archives.reading import Archive, check
from core.store import Directory
from service.access.keys import Keys
from service.errors.faults import KeysUnreadable
from service.jobs.file import open_file
from service.jobs.job import Job
from service.jobs.table import JobTable
from service.peers.alone import Alone
from service.queries.count_tables import statistics_file
from service.queries.counts import Statistics
from service.queries.statistics import QueryStatistics
from service.sessions.table import SessionRecord, SessionTable, session_file
from service.telemetry.history import LoadHistory
from tests.core.store.archives.files import exported
from tests.faults.damage import DAMAGES
from tests.faults.test_damaged_files import make_map

SEED = int(os.environ.get("PLACEREC_FAULT_SEED", "0"))
CASES = 8
CONTENT = [damage for damage in DAMAGES if damage.__name__.startswith(("flip", "cut", "zero", "append"))]
"""Damage to contents: an export comes from a user, so it is not replaced by a folder or a link."""

Use = Callable[[Path], object]
REFUSALS = (StorageFull, StorageFailure, DataDirectoryTooNew, KeysUnreadable, InvalidArchive, ArchiveTooNew)
KEY = ("lab", "2026-11-21T10:00:00+00:00")


def use_jobs(folder: Path) -> object:
    """Read all jobs, then add one."""
    ledger, _ = open_file(folder)
    try:
        table = JobTable(ledger, Alone(), longest_queue=1000, history=1000)
        found = [(job.id, job.kind, job.state, dict(job.arguments)) for job in table.all()]
        job_id = secrets.token_hex(8)
        table.add(Job(0, job_id, "verify", "lab", {"a": "x" * 50}, True, datetime(2026, 1, 1, tzinfo=UTC)))
        return found
    finally:
        ledger.close()


def use_sessions(folder: Path) -> object:
    """Read all sessions with their beliefs, then add one."""
    file = session_file(folder)
    table = SessionTable(file)
    try:
        found = [table.read(session.id) for session in table.living()]
        table.add(SessionRecord(f"s{len(found)}", "lab", KEY[1], "{}", 900.0, state=b"believed" * 20), most=100)
        return [None if one is None else replace(one, idle=0.0) for one in found]
    finally:
        file.close()


def use_statistics(folder: Path) -> object:
    """Read the statistics of a map, then count one more answer."""
    statistics = QueryStatistics(statistics_file(folder), 3600, lambda: {KEY: 5}, lambda _: set())
    try:
        found: Statistics = statistics.read(KEY)
        statistics.observe(KEY, "recognized", "p0", 0.5, 0.5)
        statistics.flush()
        return {place: count.best for place, count in found.places.items()}
    finally:
        statistics.close()


def use_keys(folder: Path) -> object:
    """Read all keys."""
    return [(key.id, key.name, key.role, key.maps, key.digest) for key in Keys.of(folder).all()]


def use_export(folder: Path) -> object:
    """Compare all parts of an export with their checksums."""
    with Archive(folder / "export.tar") as archive:
        check(archive)
    return True


def use_history(folder: Path) -> object:
    """Read the load of the last day, then count one more answer."""
    history = LoadHistory(folder)
    history.start()
    try:
        found = sum(one.recognized for one in history.read(1440)[1])
        history.observe_answer("recognized")
        return found
    finally:
        history.close()


USES: dict[str, Use] = {
    "history.sqlite": use_history,
    "jobs.sqlite": use_jobs,
    "sessions.sqlite": use_sessions,
    "statistics.sqlite": use_statistics,
    "keys.sqlite": use_keys,
    "export.tar": use_export,
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one file of each kind, used several times."""
    folder = tmp_path_factory.mktemp("small")
    for _ in range(4):
        for use in (use_jobs, use_sessions, use_statistics, use_history):
            use(folder)
    store = Keys.of(folder)
    for name in ("robot", "operator"):
        store.create(name, "query" if name == "robot" else "admin")
    atlas = Directory(folder / "maps", rows_per_segment=4)
    (folder / "export.tar").write_bytes(exported(make_map(atlas, "lab"), folder / "kept"))
    atlas.close()
    for left in ("maps", "kept"):
        shutil.rmtree(folder / left, ignore_errors=True)
    return folder


@pytest.mark.parametrize("name", USES)
def test_a_damaged_file_ends_in_no_crash(sound: Path, tmp_path: Path, name: str) -> None:
    run_cases(sound, tmp_path, name, CASES)


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", USES)
def test_a_damaged_file_in_every_way(sound: Path, tmp_path: Path, name: str) -> None:
    print(name, dict(run_cases(sound, tmp_path, name, int(os.environ.get("PLACEREC_FAULT_CASES", "1500")))))


def run_cases(sound: Path, folder: Path, name: str, count: int) -> Counter[str]:
    """Damage a file in ``count`` ways; the number of cases with each outcome."""
    chosen, outcomes, failures = random.Random(SEED), Counter[str](), []
    expected = USES[name](shutil.copytree(sound, folder / "sound"))
    for number in range(count):
        copy = folder / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(sound, copy)
        damage = chosen.choice(CONTENT if name == "export.tar" else DAMAGES[:-1])
        damage(copy / name, chosen)
        try:
            found = USES[name](copy)
            put_aside = list(copy.glob(f"{name}.damaged*"))
            outcomes["put aside" if put_aside else "harmless" if found == expected else "other"] += 1
        except (*REFUSALS, Damage) as refusal:
            assert not isinstance(refusal, Damage) or name == "sessions.sqlite"
            assert str(refusal)
            outcomes["refused"] += 1
        except Exception as error:
            failures.append(f"seed {SEED}, case {number}, {damage.__name__}: {type(error).__name__}: {error}")
    assert not failures, f"{name}: {len(failures)} of {count}:\n" + "\n".join(failures)
    if name == "export.tar":
        assert not outcomes["other"], "what is imported is what was written"
    return outcomes
