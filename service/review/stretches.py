"""Routes of new ground: the stretches of runs that left the map, which an operator accepts or rejects."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Path, Request
from pydantic import BaseModel, Field
from starlette.responses import Response

from core import errors
from core.judgement.verdict import Verdict
from core.names import texts
from core.places import Pose, Timestamp
from service.errors.faults import JobQueueFull, TooManyPlaces
from service.errors.problems import problem_documentation
from service.http.routing import WHOLE_DELETION, EngineDep, MapId, StrictRoute, single_values
from service.jobs.context import creation_time
from service.jobs.routes import JobsDep, location_of
from service.jobs.schemas import JobView
from service.learning import new_ground
from service.learning.new_ground import WaitingStretch
from service.places.map_events import tell_map

router = APIRouter(
    prefix="/v1/maps/{map}/review/stretches",
    tags=["review"],
    route_class=StrictRoute,
    dependencies=[Depends(single_values)],
)
StretchId = Annotated[
    str,
    Path(alias="stretch", description="Id of the stretch.", examples=["s-d17810d68643b4f8-3f2a90c1"]),
    texts("a stretch"),
]


class GroundFrameView(BaseModel):
    """A frame of a stretch, and the place that it would become."""

    frame: int = Field(description="Id of the stored frame; its picture is that of the frame.")
    place: str = Field(description="Id of the place as which it would be enrolled.")
    pose: Pose = Field(description="By odometry, between where the run left the map and where it came back.")
    spread: float = Field(description="Standard deviation of its position, metres.")
    heading_spread: float = Field(description="Standard deviation of its heading, degrees.")
    verdict: Verdict = Field(description="How it was answered alone.")
    taken: Timestamp | None


class GroundStretchView(BaseModel):
    """A stretch of a run off the map."""

    id: str = Field(description="Also the name of the sequence that its places would be.")
    run: str = Field(description="The session.")
    at: Timestamp = Field(description="The time at which its first frame was stored.")
    why: str
    leaves: str = Field(description="The place at which the run leaves the map.")
    returns: str = Field(description="The place at which it comes back.")
    length: float = Field(description="Metres of way between the two.")
    misclosure: float = Field(description="Metres by which odometry from the one misses the other.")
    misclosure_heading: float = Field(description="Degrees by which its heading does.")
    recognized_elsewhere: int = Field(description="Frames that were recognized alone at other places of the map.")
    missing: int = Field(description="Frames that are not stored any more, or that have another label.")
    frames: list[GroundFrameView]

    @classmethod
    def of(cls, stretch: WaitingStretch) -> GroundStretchView:
        """The JSON view of a stretch."""
        told = {name: stretch.told[name] for name in cls.model_fields if name in stretch.told and name != "frames"}
        frames = [
            GroundFrameView.model_validate(
                {
                    **{name: frame.answer["stretch"][name] for name in ("place", "pose", "spread", "heading_spread")},
                    "frame": frame.number,
                    "verdict": frame.answer["verdict"],
                    "taken": frame.answer["stretch"]["taken"],
                }
            )
            for frame in stretch.frames
        ]
        missing = stretch.told["frames"] - len(frames)
        return cls(**told, at=stretch.frames[0].at, missing=missing, frames=frames)


class GroundStretchList(BaseModel):
    """All stretches that wait for review, the oldest first, on one page."""

    items: list[GroundStretchView]
    next_cursor: None = None


@router.get("")
def list_stretches(map_id: MapId, engine: EngineDep) -> GroundStretchList:
    """List the stretches of new ground that wait for review.

    A map whose setting `learning` has `new_ground` proposes them: where a run left the map and came back to it.
    """
    found = new_ground.stretches(engine.maps.get(map_id))
    return GroundStretchList(items=[GroundStretchView.of(one) for one in found if one.open])


@router.post(
    "/{stretch}",
    status_code=202,
    responses=problem_documentation(errors.UnknownStretch, TooManyPlaces, JobQueueFull, errors.StorageFull),
)
def accept_stretch(map_id: MapId, name: StretchId, engine: EngineDep, jobs: JobsDep, response: Response) -> JobView:
    """Accept a stretch: a job makes all its frames places of the map, in one commit.

    They are a sequence with the name of the stretch, and have the poses that the list shows. What was learnt from the
    run is undone by `DELETE …/looks?run=`, and one stretch by deleting its sequence.
    """
    map_ = engine.maps.get(map_id)
    new_ground.check_room(map_, new_ground.find(map_, name))
    maps = {map_id: creation_time(map_)}
    job = jobs.submit(new_ground.KIND, map_id, arguments={"stretch": name}, maps=maps)
    response.headers["Location"] = location_of(job, engine.settings)
    return JobView.of(job)


@router.delete(
    "/{stretch}",
    status_code=204,
    dependencies=[WHOLE_DELETION],
    responses=problem_documentation(errors.UnknownStretch, errors.StorageFull),
)
def reject_stretch(map_id: MapId, name: StretchId, request: Request, engine: EngineDep) -> None:
    """Reject a stretch: its frames are thrown away, and no run proposes this ground again.

    `rejected_ground` of the map's setting `learning` lists where it was. The map remembers the latest 16 rejections;
    one that an edit of the map takes out of the list may be proposed again.
    """
    map_ = engine.maps.get(map_id)
    count = new_ground.reject(map_, name)
    tell_map(engine, map_, "edited", ["learning"])
    request.state.noted = {"map": map_id, "stretch": name, "frames": count}
