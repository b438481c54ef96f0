"""The route of the service's own state, for an operator's glance."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Depends, Request
from pydantic import BaseModel, ConfigDict, Field

from core.errors import PlacerecError
from core.maps import MapRecord
from core.places import Timestamp
from service.access.roles import Principal
from service.app.runtime import Runtime
from service.http.bodies import UploadMemory
from service.http.routing import FromState, PrincipalDep, single_values
from service.settings import Settings
from service.telemetry import latencies
from service.telemetry.history import disk_of, resident_memory
from service.worker_threads import in_thread, thread_turns

RuntimeDep = Annotated[Runtime, Depends(FromState("runtime"))]
UploadsDep = Annotated[UploadMemory, Depends(FromState("upload_memory"))]

router = APIRouter(prefix="/v1/service", tags=["service"], dependencies=[Depends(single_values)])

LIMITS = (
    "queue_length",
    "request_timeout",
    "rate_per_key",
    "rate_burst",
    "job_queue",
    "job_watchers",
    "session_expiry",
)
"""Settings that a caller has to keep to, besides those that are named ``max_…``."""


class QueueState(BaseModel):
    """The queue in front of the encoder."""

    waiting: int = Field(description="Requests that wait for the encoder or are in it.")
    limit: int = Field(description="At this number the next one is answered with 503.")


class ThreadsState(BaseModel):
    """The threads that search, read and write maps."""

    busy: int
    waiting: int = Field(description="Requests that wait for a thread.")
    threads: int


class OperationState(BaseModel):
    """The requests of one operation in the last minutes; durations in milliseconds."""

    method: str
    path: str
    count: int
    errors: int = Field(description="Answered with a status of 500 or more, or not at all.")
    p50: float
    p90: float
    p99: float
    max: float


class RequestsState(BaseModel):
    """The requests of the last minutes, without those of the console."""

    seconds: int = Field(description="The time that is looked back on.")
    under_way: int
    count: int
    errors: int
    operations: list[OperationState] = Field(description="The most frequent one first.")


class JobsState(BaseModel):
    """The jobs that have not ended."""

    queued: int
    running: int
    watchers: int = Field(description="Clients that follow jobs.")


class MemoryState(BaseModel):
    """Memory in bytes."""

    resident: int | None = Field(description="Of the process; null where the system does not report it.")
    uploads: int = Field(description="Held by bodies of requests.")
    upload_limit: int


class DiskState(BaseModel):
    """The disk of the data directory in bytes."""

    free: int
    total: int


STATE_EXAMPLE: dict[str, Any] = {
    "version": "0.3.0",
    "encoder": "m-region-vlad",
    "started_at": "2026-11-22T09:00:00Z",
    "uptime_seconds": 812.4,
    "ready": True,
    "degraded": None,
    "checks": {"encoder": "ok", "maps": "ok", "disk": "ok"},
    "queue": {"waiting": 1, "limit": 32},
    "storage": {"busy": 0, "waiting": 0, "threads": 8},
    "requests": {
        "seconds": 300,
        "under_way": 2,
        "count": 812,
        "errors": 0,
        "operations": [
            {
                "method": "POST",
                "path": "/v1/maps/{map}/query",
                "count": 700,
                "errors": 0,
                "p50": 21.2,
                "p90": 33.0,
                "p99": 61.4,
                "max": 80.1,
            }
        ],
    },
    "jobs": {"queued": 0, "running": 1, "watchers": 2},
    "sessions": 3,
    "listeners": 1,
    "maps": 4,
    "limits": {"max_image_bytes": 16777216, "queue_length": 32},
    "memory": {"resident": 812646400, "uploads": 0, "upload_limit": 536870912},
    "disk": {"free": 52613349376, "total": 105089261568},
    "settings": {"host": "127.0.0.1", "port": 8000},
}


class ServiceState(BaseModel):
    """The state of the service."""

    model_config = ConfigDict(json_schema_extra={"examples": [STATE_EXAMPLE]})

    version: str
    encoder: str = Field(description="The encoder that is used where no other is named.")
    started_at: Timestamp
    uptime_seconds: float
    ready: bool
    degraded: str | None = Field(description="As that of `/readyz`: why it takes no writes; null: it takes them.")
    checks: dict[str, str] = Field(
        description="Those of `/readyz`; each is `ok`, or a sentence that says what is wrong."
    )
    queue: QueueState
    storage: ThreadsState
    requests: RequestsState
    jobs: JobsState
    sessions: int
    listeners: int = Field(description="Clients that listen to the events of maps.")
    maps: int = Field(description="Maps in service that the key may use.")
    limits: dict[str, int | float] = Field(description="The limits for callers, by the names of the settings.")
    memory: MemoryState | None = Field(
        description="Null unless the key is an admin's for all maps; so are the next two."
    )
    disk: DiskState | None
    settings: dict[str, Any] | None = Field(description="Every setting and its value.")


@router.get("")
async def read_service(
    request: Request, runtime: RuntimeDep, uploads: UploadsDep, principal: PrincipalDep
) -> ServiceState:
    """Read the state of the service: its queues, the latencies of the last minutes, its limits, whether it is ready.

    Memory, disk and settings are shown to a key of the role `admin` that is not limited to maps.
    """
    found = await runtime.check_readiness()
    settings, engine = runtime.settings, runtime.engine
    limiter = to_thread.current_default_thread_limiter()
    states = runtime.jobs.counts()
    records: list[MapRecord] = []
    with suppress(PlacerecError):  # the checks say what is wrong
        records = await in_thread(engine.all_records)
    manages = principal.role == "admin" and principal.maps is None
    return ServiceState(
        version=request.app.version,
        encoder=settings.encoder,
        started_at=runtime.started_at,
        uptime_seconds=round(time.monotonic() - runtime.started, 3),
        ready=not found.lacking,
        degraded=None if found.degraded is None else found.degraded.told(principal.confided),
        checks=found.told_checks(principal.confided),
        queue=QueueState(waiting=engine.queue.waiting, limit=settings.queue_length),
        storage=ThreadsState(
            busy=limiter.borrowed_tokens,
            waiting=limiter.statistics().tasks_waiting + thread_turns().waiting,
            threads=int(limiter.total_tokens),
        ),
        requests=_requests(runtime),
        jobs=JobsState(queued=states["queued"], running=states["running"], watchers=len(runtime.jobs.watchers)),
        sessions=runtime.sessions.count(),
        listeners=engine.events.listeners,
        maps=_maps(principal, [record.id for record in records]),
        limits=_limits(settings),
        memory=_memory(uploads) if manages else None,
        disk=await in_thread(_disk, settings.data_dir) if manages else None,
        settings=settings.model_dump(mode="json") if manages else None,
    )


def _requests(runtime: Runtime) -> RequestsState:
    metrics = runtime.engine.metrics
    found = metrics.latencies.read()
    operations = [
        OperationState(
            method=method,
            path=path,
            count=counts.count,
            errors=counts.errors,
            p50=_milliseconds(counts.quantile(0.5)),
            p90=_milliseconds(counts.quantile(0.9)),
            p99=_milliseconds(counts.quantile(0.99)),
            max=_milliseconds(counts.longest),
        )
        for (method, path), counts in found.items()
    ]
    return RequestsState(
        seconds=latencies.SECONDS,
        under_way=round(metrics.requests_under_way()),
        count=sum(one.count for one in operations),
        errors=sum(one.errors for one in operations),
        operations=operations,
    )


def _milliseconds(seconds: float) -> float:
    return round(1e3 * seconds, 2)


def _maps(principal: Principal, map_ids: list[str]) -> int:
    return sum(principal.may_use(map_id) for map_id in map_ids)


def _limits(settings: Settings) -> dict[str, int | float]:
    names = [name for name in Settings.model_fields if name.startswith("max_") or name in LIMITS]
    return {name: getattr(settings, name) for name in names}


def _memory(uploads: UploadMemory) -> MemoryState:
    return MemoryState(resident=resident_memory(), uploads=uploads.held, upload_limit=uploads.capacity)


def _disk(directory: Path) -> DiskState | None:
    free, total = disk_of(directory)
    return None if free is None or total is None else DiskState(free=free, total=total)
