"""The file of the jobs of a service that shares them with no other one, in its data directory."""

from __future__ import annotations

import sqlite3
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path

from core.disk.files import Damage, disk_errors
from core.disk.sqlite_file import DURABLE
from core.ledger.sqlite import SqliteLedger, file_of
from service.jobs.job import Job
from service.jobs.rows import DAMAGED, READ, TABLES, job_of, values_of
from service.jobs.statements import PUT

FILE = "jobs.sqlite"

_READABLE = f"SELECT {', '.join(column.name for column in READ)} FROM jobs"


def open_file(directory: Path) -> tuple[SqliteLedger, str | None]:
    """The ledger in the file of a data directory that this process has locked.

    A damaged file is renamed and replaced by a new one; the jobs that can still be read from it are in the new one, as
    jobs that cannot be resumed.

    Returns:
        The ledger, and the new name of a damaged file; None if the file was not damaged.

    Raises:
        DataDirectoryTooNew, DataDirectoryTooOld: the file is of a version that is not read.
        StorageFull, StorageFailure: the file cannot be opened.
    """
    file = file_of(directory / FILE, TABLES, {**DURABLE, "journal_size_limit": 1 << 20}, [_READABLE])
    try:
        return SqliteLedger.open(file), None
    except Damage as damage:
        salvaged = _salvaged(file.path)
        with disk_errors(f"put {file.path} aside", FILE):
            aside = file.put_aside(damage).name
    ledger = SqliteLedger.open(file)
    for job in salvaged:
        with suppress(sqlite3.IntegrityError, sqlite3.ProgrammingError, ValueError, TypeError, OverflowError):
            ledger.execute("write down a job", PUT, **values_of(job))  # a record that is no valid job is dropped
    return ledger, aside


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
            with suppress(KeyError, TypeError, ValueError):
                job = job_of(dict(zip(names, values, strict=True)))
                found[int(job.number)] = replace(job, resumable=False, message=job.message if job.ended else DAMAGED)
    return [found[number] for number in sorted(found)]
