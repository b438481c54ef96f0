"""Routes of backups: what there is, when the next one is made, and one at once.  No request names a file."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response
from pydantic import BaseModel, ConfigDict, Field

from core import errors
from core.disk.files import disk_errors
from core.places import Timestamp
from service.backups.backups import Backups
from service.backups.shelf import Backup, BackupSchedule
from service.errors.faults import BackupFolderMissing, JobQueueFull, UnsupportedMediaType
from service.errors.problems import problem_documentation
from service.http.routing import EngineDep, FromState, StrictRoute, json_body, single_values
from service.jobs.job import Job
from service.jobs.routes import location_of
from service.jobs.schemas import JobView

BackupsDep = Annotated[Backups, Depends(FromState("backups"))]

router = APIRouter(
    prefix="/v1/backups", tags=["transfer"], route_class=StrictRoute, dependencies=[Depends(single_values)]
)

BACKUPS_EXAMPLE: dict[str, Any] = {
    "enabled": True,
    "schedule": {"hours": 24, "keep": 7},
    "next_at": "2026-11-28T02:15:00Z",
    "running": None,
    "problem": None,
    "items": [{"id": "2026-11-27T021500Z", "at": "2026-11-27T02:15:00Z", "maps": 4, "places": 8120, "bytes": 41943040}],
    "next_cursor": None,
}


class BackupView(BaseModel):
    """A backup of all maps."""

    id: str = Field(description="The name of its folder, which `placerec backup restore` restores.")
    at: Timestamp = Field(description="When it was begun.")
    maps: int
    places: int = Field(description="And their looks.")
    bytes: int = Field(description="Of all its files; those of unchanged maps take no room again.")

    @classmethod
    def of(cls, backup: Backup) -> BackupView:
        """The JSON view of a backup."""
        maps = backup.index.maps
        return cls(
            id=backup.name,
            at=backup.at,
            maps=len(maps),
            places=sum(one.places for one in maps),
            bytes=sum(one.bytes for one in maps),
        )


class BackupList(BaseModel):
    """The backups that the service makes, the newest first, and when it makes the next one."""

    model_config = ConfigDict(json_schema_extra={"examples": [BACKUPS_EXAMPLE]})

    enabled: bool = Field(description="Whether the setting `backup_dir` names a folder for them.")
    schedule: BackupSchedule | None = Field(description="Null if there is no folder.")
    next_at: Timestamp | None = Field(
        description="When the next one is due; null: only by request, as while no map has a place."
    )
    running: str | None = Field(description="Id of the job that makes one now, or waits to.")
    problem: str | None = Field(description="Why the latest one has failed; null if it has not.")
    items: list[BackupView]
    next_cursor: None = None


def _list(backups: Backups) -> BackupList:
    if not backups.enabled:
        return BackupList(enabled=False, schedule=None, next_at=None, running=None, problem=None, items=[])
    with disk_errors("read the folder of backups"):
        schedule, found = backups.shelf().schedule(), backups.shelf().backups()
    latest = backups.latest()
    due = backups.next_at(schedule, found, latest)
    return BackupList(
        enabled=True,
        schedule=schedule,
        next_at=due,
        running=latest.id if latest is not None and not latest.ended else None,
        problem=_problem_of(latest),
        items=[BackupView.of(one) for one in found],
    )


def _problem_of(latest: Job | None) -> str | None:
    if latest is None or latest.state != "failed" or latest.problem is None:
        return None
    return str(latest.problem.get("detail") or latest.problem["title"])


@router.get("", responses=problem_documentation(errors.StorageFailure))
def list_backups(backups: BackupsDep) -> BackupList:
    """List the backups that the service has made by itself, and when it makes the next one.

    Each is a folder that `placerec backup verify` and `placerec backup restore` read.
    """
    return _list(backups)


@router.put(
    "/schedule",
    dependencies=[Depends(json_body)],
    responses=problem_documentation(
        BackupFolderMissing, errors.StorageFull, errors.StorageFailure, UnsupportedMediaType
    ),
)
def schedule_backups(order: BackupSchedule, backups: BackupsDep) -> BackupList:
    """Say how often all maps are saved, and how many backups are kept."""
    with disk_errors("store the schedule of backups"):
        backups.shelf().set_schedule(order)
    return _list(backups)


@router.post(
    "",
    status_code=202,
    responses=problem_documentation(BackupFolderMissing, JobQueueFull, errors.StorageFull, errors.StorageFailure),
)
def back_up(backups: BackupsDep, engine: EngineDep, response: Response) -> JobView:
    """Save all maps now; if a job does that already, that one is the answer."""
    job = backups.submit()
    response.headers["Location"] = location_of(job, engine.settings)
    return JobView.of(job)
