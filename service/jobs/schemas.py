"""Jobs as JSON."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from core.places import Timestamp
from service.errors.problems import Problem
from service.http.schemas import Cursor
from service.jobs.records import Job, JobState

JOB_EXAMPLE: dict[str, Any] = {
    "id": "5f0c6a1de2b94c77",
    "kind": "re-encode",
    "map": "lab",
    "state": "running",
    "progress": {"done": 320, "total": 1622, "message": ""},
    "arguments": {"to": "lab-2", "encoder": "m-region-vlad"},
    "cancelling": False,
    "resumable": True,
    "attempt": 1,
    "result": None,
    "problem": None,
    "created_at": "2026-11-20T09:00:00Z",
    "started_at": "2026-11-20T09:00:00.100000Z",
    "ended_at": None,
}


class Progress(BaseModel):
    """How far a job is."""

    done: int
    total: int | None = Field(description="Null as long as it is not known.")
    message: str = Field(description="What it is at; may be empty.")


class JobView(BaseModel):
    """One piece of long work."""

    model_config = ConfigDict(json_schema_extra={"examples": [JOB_EXAMPLE]})

    id: str
    kind: str = Field(description="What it does, such as re-encode.")
    map: str | None = Field(description="The map that it works on.")
    state: JobState = Field(description="Queued, then running, then succeeded, failed or cancelled.")
    progress: Progress
    arguments: dict[str, Any] = Field(description="What it was asked for.")
    cancelling: bool = Field(description="It was asked to stop, which it does where it can.")
    resumable: bool = Field(description="After a restart of the service it goes on; any other is then failed.")
    attempt: int = Field(description="How often it was begun.")
    result: dict[str, Any] | None = Field(description="What it found or did, once it has succeeded.")
    problem: Problem | None = Field(description="Why it failed.")
    created_at: Timestamp
    started_at: Timestamp | None = Field(description="When it was last begun.")
    ended_at: Timestamp | None

    @classmethod
    def of(cls, job: Job) -> JobView:
        """The JSON view of a job."""
        return cls(
            id=job.id,
            kind=job.kind,
            map=job.map_id,
            state=job.state,
            progress=Progress(done=job.done, total=job.total, message=job.message),
            arguments=dict(job.arguments),
            cancelling=job.cancelling,
            resumable=job.resumable,
            attempt=job.attempt,
            result=None if job.result is None else dict(job.result),
            problem=None if job.problem is None else Problem(**job.problem),
            created_at=job.created_at,
            started_at=job.started_at,
            ended_at=job.ended_at,
        )


class JobPage(BaseModel):
    """Jobs, the newest first."""

    items: list[JobView]
    next_cursor: Cursor
