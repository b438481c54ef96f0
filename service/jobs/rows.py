"""The columns of the table of jobs, and a job as a row of it."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Column, Index, MetaData, Table

from core.ledger import Tables
from core.ledger.statements import integer, real, text
from service.jobs.job import ENDED, STATES, Job, JobState

DAMAGED = "its record was damaged"
"""The message of a job whose row cannot be read."""

log = logging.getLogger("placerec.jobs")

_METADATA = MetaData()
JOBS = Table(
    "jobs",
    _METADATA,
    Column("number", integer(), primary_key=True, autoincrement=True),
    Column("id", text(), nullable=False, unique=True),
    Column("kind", text(), nullable=False),
    Column("map", text()),
    Column("state", text(), nullable=False),
    Column("resumable", integer(), nullable=False),
    Column("cancelling", integer(), nullable=False),
    Column("attempt", integer(), nullable=False),
    Column("change", integer(), nullable=False),
    Column("done", integer(), nullable=False),
    Column("total", integer()),
    Column("message", text(), nullable=False),
    Column("created_at", real(), nullable=False),  # moments are seconds since 1970, by the service's clock
    Column("started_at", real()),
    Column("ended_at", real()),
    Column("home", text()),
    Column("owner", text()),  # the service that does it
    Column("behind", integer()),  # it gave way to the jobs up to this number; NULL: it did not
    Column("yielded", integer(), nullable=False, default=0),  # orders those that gave way to the same ones
    Column("arguments", text(), nullable=False),  # this and what follows is JSON
    Column("notes", text(), nullable=False),
    Column("result", text()),
    Column("problem", text()),
    Column("maps", text(), nullable=False),
    Column("asker", text(), nullable=False),
    sqlite_strict=True,
    sqlite_autoincrement=True,
)
_OPEN = JOBS.c.ended_at.is_(None)
Index("open_jobs", JOBS.c.map, JOBS.c.number, sqlite_where=_OPEN, postgresql_where=_OPEN)
TABLES = Tables("jobs", 4, _METADATA)

READ = tuple(column for column in JOBS.columns if column.name not in ("owner", "behind", "yielded"))
"""The columns of which a job is made."""

_NAMES = tuple(column.name for column in READ)
_JSON = ("arguments", "notes", "result", "problem", "maps", "asker")
_MOMENTS = ("created_at", "started_at", "ended_at")
_EPOCH = datetime.fromtimestamp(0, UTC)


def values_of(job: Job) -> dict[str, Any]:
    """The values of the columns ``READ`` of a job."""
    values = {name: getattr(job, name) for name in _NAMES if name != "map"} | {"map": job.map_id}
    for name in _JSON:
        values[name] = None if values[name] is None else json.dumps(dict(values[name]))
    for name in _MOMENTS:
        values[name] = None if values[name] is None else values[name].timestamp()
    return values | {"resumable": int(job.resumable), "cancelling": int(job.cancelling)}


def job_of(row: Sequence[Any] | Mapping[str, Any]) -> Job:
    """The job of a row with the columns ``READ``; a damaged row gives a job with the message ``DAMAGED``."""
    columns = dict(row) if isinstance(row, Mapping) else dict(zip(_NAMES, row, strict=True))
    try:
        return _whole(columns)
    except (ValueError, TypeError, KeyError, OverflowError, OSError) as error:
        log.error("the record of the job %s cannot be read: %s", columns["id"], error)
        return _remains(columns)


def _whole(columns: Mapping[str, Any]) -> Job:
    values = {name: columns[name] for name in _NAMES}
    values["map_id"] = values.pop("map")
    for name in _JSON:
        if (text := values[name]) is not None:
            values[name] = {} if text == "{}" else dict(json.loads(text))
    for name in _MOMENTS:
        if (moment := values[name]) is not None:
            values[name] = datetime.fromtimestamp(moment, UTC)
    for name in ("resumable", "cancelling"):
        values[name] = bool(values[name])
    job = Job(**values)
    if job.state not in STATES or job.ended != (job.ended_at is not None):
        raise ValueError("its state is unknown")
    return job


def _remains(columns: Mapping[str, Any]) -> Job:
    """A job of what a damaged row still says."""
    state: JobState = columns["state"] if columns["state"] in ENDED else "running"
    job = Job(
        **{name: columns[name] for name in ("number", "id", "kind")}, map_id=columns["map"], arguments={},
        resumable=False, created_at=_EPOCH, state=state, ended_at=_EPOCH if state in ENDED else None,
    )  # fmt: skip
    return replace(job, message=DAMAGED)
