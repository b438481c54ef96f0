"""The records of jobs, in a small SQLite file in the data directory."""

from __future__ import annotations

import json
import logging
import sqlite3
import threading
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from core.errors import DataDirectoryTooNew
from core.storage.files.disk import Damage, refusals

FILE = "jobs.sqlite"
VERSION = 3

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
ENDED: frozenset[JobState] = frozenset({"succeeded", "failed", "cancelled"})

DAMAGED = "its record was damaged"

log = logging.getLogger("placerec.jobs")

_TABLE = """CREATE TABLE jobs (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT NOT NULL UNIQUE,
    kind TEXT NOT NULL,
    map TEXT,
    state TEXT NOT NULL,
    arguments TEXT NOT NULL,
    resumable INTEGER NOT NULL,
    cancelling INTEGER NOT NULL,
    attempt INTEGER NOT NULL,
    change INTEGER NOT NULL,
    done INTEGER NOT NULL,
    total INTEGER,
    message TEXT NOT NULL,
    notes TEXT NOT NULL,
    result TEXT,
    problem TEXT,
    created_at TEXT NOT NULL,
    started_at TEXT,
    ended_at TEXT,
    maps TEXT NOT NULL DEFAULT '{}',
    asker TEXT NOT NULL DEFAULT '{}'
) STRICT"""

_MIGRATIONS = {
    1: "ALTER TABLE jobs ADD COLUMN maps TEXT NOT NULL DEFAULT '{}'",
    2: "ALTER TABLE jobs ADD COLUMN asker TEXT NOT NULL DEFAULT '{}'",
}
"""From a version to the next one."""


@dataclass(frozen=True)
class Job:
    """The state of a job at one moment.

    number: counts the jobs; a later job has a larger number.
    arguments: the arguments of the job, as JSON values.
    resumable: whether the job is resumed from ``arguments`` and ``notes`` after a restart.
    cancelling: whether the job was asked to stop.
    attempt: how often the job was started.
    change: counts the changes of the job within the attempt.
    done, total: steps that are done, and all steps; the total is None while it is not known.
    notes: what the job has stored for its next attempt.
    result: the result of a job that has succeeded.
    problem: why the job failed, as a problem object (RFC 9457).
    maps: the ids of the maps that the job uses, with the time at which each was created: a map of the same id that was
        created at another time is another map.
    asker: who submitted the job, as ``service.access.principals.Asker`` has it; for the audit trail.
    """

    number: int
    id: str
    kind: str
    map_id: str | None
    arguments: Mapping[str, Any]
    resumable: bool
    created_at: datetime
    state: JobState = "queued"
    cancelling: bool = False
    attempt: int = 0
    change: int = 0
    done: int = 0
    total: int | None = None
    message: str = ""
    notes: Mapping[str, Any] = field(default_factory=dict)
    result: Mapping[str, Any] | None = None
    problem: Mapping[str, Any] | None = None
    started_at: datetime | None = None
    ended_at: datetime | None = None
    maps: Mapping[str, str] = field(default_factory=dict)
    asker: Mapping[str, Any] = field(default_factory=dict)

    @property
    def ended(self) -> bool:
        """Whether the job has succeeded, failed or been cancelled."""
        return self.state in ENDED

    @property
    def version(self) -> str:
        """Identifies this state of the job; every change gives another version."""
        return f"{self.attempt}.{self.change}"


class JobRecords:
    """The file of the jobs.  Thread-safe; what a method writes is synced when it returns.

    Every method may raise StorageFull and StorageFailure.
    """

    def __init__(self, directory: Path) -> None:
        """Open the file of a data directory that this process holds.

        A damaged file is renamed and replaced by a new one; the jobs that can still be read from it are kept as jobs
        that cannot be resumed.

        Raises:
            DataDirectoryTooNew: a later version of placerec wrote the file.
            StorageFull, StorageFailure: the file cannot be opened.
        """
        self._lock = threading.Lock()
        self.put_aside: str | None = None
        """The new name of a damaged file; None if the file was not damaged."""
        path = directory / FILE
        with refusals(f"open {path}"):
            try:
                self._connection = _open(path)
            except Damage as damage:
                aside = path.with_name(f"{FILE}.damaged-{datetime.now(UTC):%Y%m%dT%H%M%S}")
                log.error("%s cannot be read and is put aside as %s: %s", path, aside.name, damage)
                salvaged = _salvaged(path)
                path.rename(aside)
                for suffix in ("-wal", "-shm"):
                    with suppress(FileNotFoundError):
                        path.with_name(FILE + suffix).unlink()
                self._connection, self.put_aside = _open(path), aside.name
                for job in salvaged:
                    with suppress(sqlite3.IntegrityError, sqlite3.ProgrammingError, ValueError, TypeError):
                        self.put(job)  # a record that is no valid job is dropped

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._connection.close()

    def read(self) -> list[Job]:
        """All jobs, the oldest first."""
        with self._lock, refusals("read the jobs"), closing(self._connection.cursor()) as cursor:
            cursor.execute("SELECT * FROM jobs ORDER BY number")
            names = [column[0] for column in cursor.description]
            return [_readable(dict(zip(names, values, strict=True))) for values in cursor.fetchall()]

    def put(self, job: Job) -> None:
        """Write a job, new or changed."""
        columns = _columns(job)
        names, marks = ", ".join(columns), ", ".join("?" * len(columns))
        with self._lock, refusals("write down a job"):
            self._connection.execute(f"INSERT OR REPLACE INTO jobs ({names}) VALUES ({marks})", tuple(columns.values()))

    def update(self, job: Job) -> None:
        """Write a changed job, except its arguments and notes, which do not change here and may be long."""
        columns = {name: value for name, value in _columns(job).items() if name not in ("arguments", "notes")}
        assignments = ", ".join(f"{name} = ?" for name in columns)
        with self._lock, refusals("write down a job"):
            self._connection.execute(f"UPDATE jobs SET {assignments} WHERE number = ?", (*columns.values(), job.number))

    def forget(self, numbers: list[int]) -> None:
        """Delete jobs."""
        with self._lock, refusals("forget a job"):
            self._connection.execute(
                "DELETE FROM jobs WHERE number IN (SELECT value FROM json_each(?))", (json.dumps(numbers),)
            )

    def last_number(self) -> int:
        """The largest number that a job ever had; 0 if there never was a job."""
        with self._lock, refusals("read the jobs"):
            found = self._connection.execute("SELECT seq FROM sqlite_sequence WHERE name = 'jobs'").fetchone()
        return 0 if found is None else int(found[0])


def _open(path: Path) -> sqlite3.Connection:
    """A connection to the file, which is made if it is not there.

    Raises:
        Damage: it is no database, or not one of ours.
    """
    connection = sqlite3.connect(path, timeout=30, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("PRAGMA journal_size_limit = 1048576")
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if version > VERSION:
            raise DataDirectoryTooNew(f"{path} was written by a later version of placerec (schema {version}).")
        if version == 0:
            if connection.execute("SELECT 1 FROM sqlite_schema").fetchone():
                raise Damage("it holds tables that are not ours")
            connection.execute("BEGIN IMMEDIATE")
            connection.execute(_TABLE)
            connection.execute(f"PRAGMA user_version = {VERSION}")
            connection.execute("COMMIT")
        for old in range(version or VERSION, VERSION):
            connection.execute("BEGIN IMMEDIATE")
            connection.execute(_MIGRATIONS[old])
            connection.execute(f"PRAGMA user_version = {old + 1}")
            connection.execute("COMMIT")
        for (line,) in connection.execute("PRAGMA quick_check").fetchall():
            if line != "ok":
                raise Damage(line)
        connection.execute(f"SELECT {', '.join(_NAMES)} FROM jobs").fetchall()  # can all of it be read?
        # SQLite opens a file for reading alone where writing is refused, and it would stay so.
        connection.execute("UPDATE jobs SET id = id WHERE false")
    except sqlite3.DatabaseError as error:
        connection.close()
        told = str(error)
        if isinstance(error, sqlite3.OperationalError) and "no such" not in told and "decode" not in told:
            raise  # the disk refuses
        raise Damage(str(error)) from error
    except UnicodeDecodeError as error:
        connection.close()
        raise Damage("its text is damaged") from error
    except BaseException:
        connection.close()
        raise
    return connection


def _columns(job: Job) -> dict[str, Any]:
    return {
        "number": job.number,
        "id": job.id,
        "kind": job.kind,
        "map": job.map_id,
        "state": job.state,
        "arguments": json.dumps(dict(job.arguments)),
        "resumable": job.resumable,
        "cancelling": job.cancelling,
        "attempt": job.attempt,
        "change": job.change,
        "done": job.done,
        "total": job.total,
        "message": job.message,
        "notes": json.dumps(dict(job.notes)),
        "result": None if job.result is None else json.dumps(dict(job.result)),
        "problem": None if job.problem is None else json.dumps(dict(job.problem)),
        "created_at": _text(job.created_at),
        "started_at": _text(job.started_at),
        "ended_at": _text(job.ended_at),
        "maps": json.dumps(dict(job.maps)),
        "asker": json.dumps(dict(job.asker)),
    }


def _text(moment: datetime | None) -> str | None:
    return None if moment is None else moment.isoformat(timespec="microseconds")


def _job(columns: dict[str, Any]) -> Job:
    columns["map_id"] = columns.pop("map")
    for name in ("arguments", "notes", "result", "problem", "maps", "asker"):
        columns[name] = None if columns[name] is None else json.loads(columns[name])
    for name in ("created_at", "started_at", "ended_at"):
        columns[name] = None if columns[name] is None else datetime.fromisoformat(columns[name])
    for name in ("resumable", "cancelling"):
        columns[name] = bool(columns[name])
    return Job(**columns)


def _readable(columns: dict[str, Any]) -> Job:
    """The job of a row; a damaged row gives a job without arguments, which cannot be resumed."""
    try:
        return _job(dict(columns))
    except (ValueError, TypeError, KeyError) as error:
        log.error("the record of the job %s cannot be read: %s", columns["id"], error)
        known = {name: columns[name] for name in ("number", "id", "kind")}
        state: JobState = columns["state"] if columns["state"] in ENDED else "running"
        job = Job(**known, map_id=columns["map"], arguments={}, resumable=False, created_at=_EPOCH, state=state)
        return replace(job, message=DAMAGED)


def _salvaged(path: Path) -> list[Job]:
    """The jobs that can be read from a damaged file, none of which can be resumed."""
    found: dict[int, Job] = {}
    with (
        suppress(sqlite3.Error, UnicodeDecodeError, TypeError),
        closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as connection,
    ):
        rows = connection.execute("SELECT * FROM jobs")
        names = [column[0] for column in rows.description]
        for values in rows:
            columns = dict(zip(names, values, strict=True))
            with suppress(KeyError, TypeError, ValueError):
                job = _readable({"maps": "{}", "asker": "{}"} | columns)
                found[int(job.number)] = replace(job, resumable=False, message=DAMAGED)
    return [found[number] for number in sorted(found)]


_EPOCH = datetime.fromtimestamp(0, UTC)
_NAMES = tuple(_columns(Job(0, "", "", None, {}, False, datetime.min)))
