"""Routes of jobs: list, read, follow and cancel."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from typing import Annotated

from fastapi import APIRouter, Depends, Path, Query, Request
from pydantic import Field
from starlette.responses import JSONResponse, Response, StreamingResponse

from core import errors
from core.maps.pagination import Listing, decode_number, page_of
from core.numerals import Decimal
from service.access.roles import OPERATIONS, UNLISTED, Principal, covers
from service.errors.faults import Fault, JobEnded, RoleTooLow, TooManyWatchers, UnknownJob
from service.errors.problems import problem_documentation
from service.http.event_stream import (
    HEARTBEAT,
    HEARTBEAT_SECONDS,
    OPENING,
    LastEventId,
    described,
    event_text,
    set_or_refused,
    stream_response,
)
from service.http.routing import FromState, PrincipalDep, StrictRoute, single_values
from service.http.schemas import PageParameters
from service.jobs.context import NOTICE_SECONDS
from service.jobs.job import Job, JobState
from service.jobs.jobs import Jobs
from service.jobs.schemas import JobPage, JobView
from service.settings import Settings
from service.worker_threads import in_thread

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], route_class=StrictRoute, dependencies=[Depends(single_values)])

LONGEST_WAIT = 60.0
"""The longest time, in seconds, that a read of a job waits for its end."""

JobsDep = Annotated[Jobs, Depends(FromState("jobs"))]


def location_of(job: Job, settings: Settings) -> str:
    """The path at which a job can be read, for the header ``Location``."""
    return f"{settings.root_path}{router.prefix}/{job.id}"


def accepted(job: Job, settings: Settings) -> Response:
    """The answer 202 with a job that was submitted, and its path in ``Location``."""
    return JSONResponse(JobView.of(job).model_dump(mode="json"), 202, {"Location": location_of(job, settings)})


class JobPageParameters(PageParameters):
    """The parameters of a list of jobs."""

    map: str | None = Field(default=None, max_length=64, description="Only the jobs of this map.")
    kind: str | None = Field(default=None, max_length=64, description="Only the jobs of this kind.")
    state: JobState | None = Field(default=None, description="Only the jobs in this state.")


JobPageQuery = Annotated[JobPageParameters, Query()]
JobId = Annotated[str, Path(alias="job", max_length=64, description="Id of the job.", examples=["5f0c6a1de2b94c77"])]
Wait = Annotated[
    Decimal,
    Query(
        ge=0, le=LONGEST_WAIT, allow_inf_nan=False, description="Seconds to wait for the job's end before answering."
    ),
]


@router.get("", responses=problem_documentation(errors.InvalidCursor))
def list_jobs(page: JobPageQuery, jobs: JobsDep, principal: PrincipalDep) -> JobPage:
    """List jobs, the newest first; only the latest ended jobs are stored."""
    listing: Listing = ["jobs", page.map, page.kind, page.state]
    after = decode_number(listing, page.cursor)
    found = [
        job
        for job in reversed(jobs.all())
        if (after < 0 or job.number < after)
        and page.map in (None, job.map_id)
        and page.kind in (None, job.kind)
        and page.state in (None, job.state)
        and principal.may_use(*job.used_maps())
    ]
    shown, more = page_of(listing, found, page.limit, lambda job: job.number)
    return JobPage(items=[JobView.of(job) for job in shown], next_cursor=more)


@router.get("/{job}", responses=problem_documentation(UnknownJob, TooManyWatchers))
async def read_job(
    job_id: JobId, request: Request, jobs: JobsDep, principal: PrincipalDep, wait: Wait = 0.0
) -> JobView:
    """Read the state of a job. With `wait` the answer comes when the job has ended, or when that time is over."""
    job = await in_thread(_job_for, jobs, principal, job_id)
    if wait and not job.ended:
        until = time.monotonic() + wait
        with jobs.watchers.watching(job_id) as changed:
            while not (job := await in_thread(jobs.get, job_id)).ended and not (jobs.stopping or changed.over):
                left = until - time.monotonic()
                if not await set_or_refused(changed, left, lambda: request.app.state.gate.identify(request.scope)):
                    break
    return JobView.of(await in_thread(jobs.get, job_id))


@router.get(
    "/{job}/events",
    response_class=StreamingResponse,
    responses={
        200: described(
            "Each is named after the state of the job; its data is the job, and its id identifies this version of the "
            "job. The stream ends with the job."
        ),
        204: {"description": "The job has ended, and the client has received its last event."},
        **problem_documentation(UnknownJob, TooManyWatchers),
    },
)
async def follow_job(
    job_id: JobId, request: Request, jobs: JobsDep, principal: PrincipalDep, last_event_id: LastEventId = None
) -> Response:
    """Follow a job by server-sent events.

    Each event contains the whole job, so a client that connects late, or again with `Last-Event-ID`, misses nothing
    that still holds.
    """
    job = await in_thread(_job_for, jobs, principal, job_id)
    if job.ended and last_event_id == job.version:
        return Response(status_code=204)  # this status stops a browser from reconnecting
    stream = _events(jobs, job_id, last_event_id, lambda: request.app.state.gate.identify(request.scope))
    return await stream_response(request, stream)


@router.post(
    "/{job}/cancel", responses=problem_documentation(UnknownJob, JobEnded, errors.StorageFull, errors.StorageFailure)
)
def cancel_job(job_id: JobId, jobs: JobsDep, principal: PrincipalDep) -> JobView:
    """Ask a job to stop.

    A waiting job is cancelled at once; a running job stops at the next point where it can, and undoes what must not
    stay half done. Cancelling twice is no error. It needs the same role as submitting the job.
    """
    job = _job_for(jobs, principal, job_id)
    needed = OPERATIONS.get(str(job.asker.get("operation")), UNLISTED).role
    if not covers(principal.role, needed):
        raise RoleTooLow(f"The key {principal.name!r} has the role {principal.role}; this job needs {needed}.")
    return JobView.of(jobs.cancel(job_id))


def _job_for(jobs: Jobs, principal: Principal, job_id: str) -> Job:
    """A job, if the caller may use all its maps.

    Raises:
        UnknownJob: there is no such job, or the caller may not use one of its maps.
    """
    job = jobs.get(job_id)
    if not principal.may_use(*job.used_maps()):
        raise UnknownJob(f"There is no job {job_id[:80]!r}.")
    return job


async def _events(jobs: Jobs, job_id: str, last: str | None, check_key: Callable[[], object]) -> AsyncIterator[str]:
    """The events after ``last``, until the job ends, the service stops, the caller's key is revoked, or another caller
    needs the place."""
    with jobs.watchers.watching(job_id) as changed:
        yield OPENING
        while True:
            try:
                job = await in_thread(jobs.get, job_id)
            except UnknownJob:
                return  # the job ended and was forgotten before the caller read on
            if job.version != last:
                last = job.version
                yield _event(job)
            if job.ended or jobs.stopping or changed.over:
                return
            try:
                changed_now = await set_or_refused(changed, HEARTBEAT_SECONDS, check_key)
                if not changed_now:
                    yield HEARTBEAT
                await asyncio.sleep(NOTICE_SECONDS)
                check_key()
            except Fault:
                return


def _event(job: Job) -> str:
    data = json.dumps(JobView.of(job).model_dump(mode="json"))
    return event_text(job.version, job.state, data)
