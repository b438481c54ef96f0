"""Long work as it is told and remembered: one record a job, in a small SQLite file beside the maps."""

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
from core.disk.sqlite_file import DURABLE, Schema, SqliteFile, TooNew
from core.errors import DataDirectoryTooNew

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

_SCHEMA = Schema(
    application_id=0,
    version=3,
    create=[_TABLE],
    migrations={
        1: ["ALTER TABLE jobs ADD COLUMN maps TEXT NOT NULL DEFAULT '{}'"],
        2: ["ALTER TABLE jobs ADD COLUMN asker TEXT NOT NULL DEFAULT '{}'"],
    },
)


@dataclass(frozen=True)
class Job:
    """One piece of long work, as of one moment.

    number: grows from job to job.
    arguments: what it was asked for, as JSON.
    resumable: after a restart it is done again from ``arguments`` and ``notes``.
    cancelling: it was asked to stop.
    attempt: how often it was begun.
    change: counts what became of it within the attempt.
    done, total: of whatever it works through; the total may not be known yet.
    notes: what it wrote down for its next attempt.
    result: what it found, once it has succeeded.
    problem: why it failed, as a problem object.
    maps: the maps that it was asked for, by id, and when each was created: one of the same id that was created at
        another time is another map.
    asker: who asked for it, as ``service.access.audit.Asker`` has it; for the audit trail.
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
        """Nothing will become of it any more."""
        return self.state in ENDED

    @property
    def version(self) -> str:
        """Names this moment of the job; of two, the later one differs."""
        return f"{self.attempt}.{self.change}"


class JobRecords:
    """The file; from any thread.  What a method wrote is synced when it returns.

    Every method may raise StorageFull and StorageFailure: the disk refuses.
    """

    def __init__(self, directory: Path) -> None:
        """Open the file in a data directory that this process has locked.

        A damaged file is put aside, because jobs can be submitted again and maps do not depend on them.  What can
        still be read of it is kept as jobs that cannot go on.

        Raises:
            DataDirectoryTooNew: a later version of placerec wrote it.
            StorageFull, StorageFailure.
        """
        self._lock = threading.Lock()
        self.put_aside: str | None = None
        """Under which name the file was put aside because it was damaged, if it was."""
        readable = f"SELECT {', '.join(_NAMES)} FROM jobs"
        file = SqliteFile(directory / FILE, _SCHEMA, {**DURABLE, "journal_size_limit": 1 << 20}, [readable])
        with disk_errors(f"open {file.path}", FILE):
            try:
                self._connection = file.open()
            except TooNew as error:
                raise DataDirectoryTooNew(
                    f"{file.path} was written by a later version of placerec (schema {error.version})."
                ) from error
            except Damage as damage:
                salvaged = _salvaged(file.path)
                self.put_aside = file.put_aside(damage).name
                self._connection = file.open()
                for job in salvaged:
                    with suppress(sqlite3.IntegrityError, sqlite3.ProgrammingError, ValueError, TypeError):
                        self.put(job)  # unless nothing that a job can be is left of it

    def close(self) -> None:
        """Nothing can be written from here on."""
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
        """Write what changes of a job as it goes on: all but its arguments and notes, which may be long."""
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
        """The largest number that a job ever had; 0 if there was none."""
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
    """A job; of one whose record makes no sense, what can be told of it: it cannot go on."""
    try:
        return _job(dict(columns))
    except (ValueError, TypeError, KeyError) as error:
        log.error("the record of the job %s cannot be read: %s", columns["id"], error)
        known = {name: columns[name] for name in ("number", "id", "kind")}
        state: JobState = columns["state"] if columns["state"] in ENDED else "running"
        job = Job(**known, map_id=columns["map"], arguments={}, resumable=False, created_at=_EPOCH, state=state)
        return replace(job, message=DAMAGED)


def _salvaged(path: Path) -> list[Job]:
    """The jobs of a damaged file, as far as it can be read; none of them can go on."""
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
