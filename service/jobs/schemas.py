"""Jobs as JSON."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from core.places import Timestamp
from service.errors.problems import Problem
from service.http.schemas import Cursor
from service.jobs.job import Job, JobState

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
    total: int | None = Field(description="Null while it is not known.")
    message: str = Field(description="The present step of the job; may be empty.")


class JobView(BaseModel):
    """A job: long work in the background."""

    model_config = ConfigDict(json_schema_extra={"examples": [JOB_EXAMPLE]})

    id: str
    kind: str = Field(description="The kind of the job, such as re-encode.")
    map: str | None = Field(description="The map that the job works on.")
    state: JobState = Field(description="Queued, then running, then succeeded, failed or cancelled.")
    progress: Progress
    arguments: dict[str, Any] = Field(description="The arguments with which the job was submitted.")
    cancelling: bool = Field(description="The job was cancelled, and stops at the next point where it can.")
    resumable: bool = Field(description="The job goes on after a restart of the service; otherwise it then fails.")
    attempt: int = Field(description="How often the job was started.")
    result: dict[str, Any] | None = Field(
        description="The result, once the job has succeeded, as its kind has it; of `learn`, `refused` counts by their "
        "reasons the frames that were not proposed."
    )
    problem: Problem | None = Field(description="Why the job failed.")
    created_at: Timestamp
    started_at: Timestamp | None = Field(description="When the job was last started.")
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
