"""A job: long work in the background, as it is at one moment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal, get_args

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
STATES: frozenset[JobState] = frozenset(get_args(JobState))
ENDED: frozenset[JobState] = frozenset({"succeeded", "failed", "cancelled"})


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
    home: the id of the only service that can do the job; None: any can.
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
    home: str | None = None

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
