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

from core.disk.files import Damage, disk_errors
from core.disk.sqlite_file import DURABLE, Schema, SqliteFile, UnreadVersion

FILE = "jobs.sqlite"

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

_SCHEMA = Schema(application_id=0, version=3, create=[_TABLE])


@dataclass(frozen=True)
class Job:
    """The state of a job at one moment.

    number: counts the jobs; a later job has a larger number.
    arguments: the arguments of the job, as JSON values.
    resumable: whether the job is resumed from ``arguments`` and ``notes`` after a restart.
    cancelling: whether the job was cancelled.
    attempt: how often the job was started.
    change: counts the changes of the job within the attempt.
    done, total: steps that are done, and all steps; the total is None while it is not known.
    notes: stored by the job for its next attempt.
    result: the result of a job that has succeeded.
    problem: why the job failed, as a problem object (RFC 9457).
    maps: the ids of the maps that the job uses, with the time at which each was created: a map of the same id that was
        created at another time is another map.
    asker: its caller, the fields of ``service.access.audit.Asker``; for the audit trail.
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

    def used_maps(self) -> set[str | None]:
        """The ids of the maps that the job uses; None is among them if the job works on no map in particular."""
        named = {self.arguments.get(name) for name in ("from", "to")}
        return {self.map_id, *self.maps, *(name for name in named if isinstance(name, str))}

    @property
    def version(self) -> str:
        """Identifies this state of the job; every change gives another version."""
        return f"{self.attempt}.{self.change}"


class JobRecords:
    """The file of the jobs.  Thread-safe; the writes of a method are synced when it returns.

    Every method may raise StorageFull and StorageFailure.
    """

    def __init__(self, directory: Path) -> None:
        """Open the file in a data directory that this process has locked.

        A damaged file is renamed and replaced by a new one; the jobs that can still be read from it stay as jobs
        that cannot be resumed.

        Raises:
            DataDirectoryTooNew, DataDirectoryTooOld: the file is of a version that is not read.
            StorageFull, StorageFailure: the file cannot be opened.
        """
        self._lock = threading.Lock()
        self.put_aside: str | None = None
        """The new name of a damaged file; None if the file was not damaged."""
        readable = f"SELECT {', '.join(_NAMES)} FROM jobs"
        file = SqliteFile(directory / FILE, _SCHEMA, {**DURABLE, "journal_size_limit": 1 << 20}, [readable])
        with disk_errors(f"open {file.path}", FILE):
            try:
                self._connection = file.open()
            except UnreadVersion as error:
                raise error.refusal(str(file.path)) from error
            except Damage as damage:
                salvaged = _salvaged(file.path)
                self.put_aside = file.put_aside(damage).name
                self._connection = file.open()
                for job in salvaged:
                    with suppress(sqlite3.IntegrityError, sqlite3.ProgrammingError, ValueError, TypeError):
                        self.put(job)  # a record that is no valid job is dropped

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._connection.close()

    def read(self) -> list[Job]:
        """All jobs, the oldest first."""
        with self._lock, disk_errors("read the jobs"), closing(self._connection.cursor()) as cursor:
            cursor.execute("SELECT * FROM jobs ORDER BY number")
            names = [column[0] for column in cursor.description]
            return [_readable(dict(zip(names, values, strict=True))) for values in cursor.fetchall()]

    def put(self, job: Job) -> None:
        """Write a job, new or changed."""
        columns = _columns(job)
        names, marks = ", ".join(columns), ", ".join("?" * len(columns))
        with self._lock, disk_errors("write down a job"):
            self._connection.execute(f"INSERT OR REPLACE INTO jobs ({names}) VALUES ({marks})", tuple(columns.values()))

    def update(self, job: Job) -> None:
        """Write a changed job, except its arguments and notes, which do not change here and may be long."""
        columns = {name: value for name, value in _columns(job).items() if name not in ("arguments", "notes")}
        assignments = ", ".join(f"{name} = ?" for name in columns)
        with self._lock, disk_errors("write down a job"):
            self._connection.execute(f"UPDATE jobs SET {assignments} WHERE number = ?", (*columns.values(), job.number))

    def forget(self, numbers: list[int]) -> None:
        """Delete jobs."""
        with self._lock, disk_errors("forget a job"):
            self._connection.execute(
                "DELETE FROM jobs WHERE number IN (SELECT value FROM json_each(?))", (json.dumps(numbers),)
            )

    def last_number(self) -> int:
        """The largest number that a job ever had; 0 if there never was a job."""
        with self._lock, disk_errors("read the jobs"):
            found = self._connection.execute("SELECT seq FROM sqlite_sequence WHERE name = 'jobs'").fetchone()
        return 0 if found is None else int(found[0])


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
                job = _readable(columns)
                found[int(job.number)] = replace(job, resumable=False, message=DAMAGED)
    return [found[number] for number in sorted(found)]


_EPOCH = datetime.fromtimestamp(0, UTC)
_NAMES = tuple(_columns(Job(0, "", "", None, {}, False, datetime.min)))
