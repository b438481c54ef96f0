"""Looks: pictures of a place under other conditions, by which it is recognized as well; routes and their JSON."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Path, Query, Request
from pydantic import AfterValidator, BaseModel, Field
from starlette.responses import Response

from core import errors
from core.maps import Change
from core.names import texts
from core.places import Look, PlaceFields, Timestamp, check_look, look_address
from service.errors.problems import problem_documentation
from service.http.openapi import frame_body
from service.http.routing import (
    WHOLE_DELETION,
    DeadlineDep,
    EngineDep,
    MapId,
    PlaceId,
    StrictRoute,
    frame_for_map,
    milliseconds_since,
    rounded,
    single_values,
    started,
)
from service.http.schemas import (
    IDENTITY_EXAMPLE,
    CameraName,
    Cursor,
    EncoderAssertion,
    Milliseconds,
    PageParameters,
    Parameters,
)
from service.places.enrolment import enrol_look
from service.places.parameters import check_taken
from service.places.place_events import tell_change
from service.places.routes import ENROLMENT_PROBLEMS, THUMBNAIL
from service.worker_threads import in_thread

router = APIRouter(
    prefix="/v1/maps/{map}",
    tags=["places"],
    route_class=StrictRoute,
    dependencies=[Depends(single_values)],
)

LookName = Annotated[
    str, Path(alias="look", description="Name of the look.", examples=["8f3a0c52d41b9e07"]), AfterValidator(check_look)
]
Run = Annotated[str, texts("a run")]


class LookParameters(Parameters):
    """Beside the frame of a look."""

    timestamp: Timestamp | None = Field(
        default=None,
        description="When the frame was taken (ISO 8601; UTC without a zone).",
        examples=["2026-11-20T22:00:00Z"],
    )
    camera: CameraName = None
    encoder: EncoderAssertion = None


class LookView(Look):
    """A look of a place beside its first."""

    place: str = Field(description="The place that it is of.")


class AddedLook(LookView):
    """A look after a POST."""

    change: Change = Field(description="created: a new look; unchanged: the place had it.")
    encoder: str = Field(description="Identity of the map's encoder.", examples=[IDENTITY_EXAMPLE])
    milliseconds: Milliseconds


class LookPage(BaseModel):
    """Looks in the order in which they were added."""

    items: list[LookView]
    next_cursor: Cursor


class LookPageParameters(PageParameters):
    """Which looks."""

    run: Run | None = Field(default=None, description="Only those that were learnt from this run.")


@router.post(
    "/places/{place}/looks",
    status_code=201,
    openapi_extra=frame_body(LookParameters),
    responses={
        200: {"model": AddedLook, "description": "The place had this look."},
        **problem_documentation(
            *ENROLMENT_PROBLEMS,
            errors.UnknownPlace,
            errors.UnknownLook,
            errors.RepeatedLook,
            errors.LookNameTaken,
            errors.TooManyLooks,
        ),
    },
)
async def add_look(
    map_id: MapId,
    place_id: PlaceId,
    options: Annotated[LookParameters, Query()],
    request: Request,
    response: Response,
    engine: EngineDep,
    deadline: DeadlineDep,
) -> AddedLook:
    """Add a look to a place: a frame of it at night, in snow, or behind a parked car.

    The place stays one place: it has one id, pose and metadata, and a query finds it by any of its looks. The name of
    a look follows from its frame, so a request can be repeated until it succeeds.
    """
    map_, data, options = await frame_for_map(request, engine, map_id, options)
    check_taken(options.timestamp)
    fields = PlaceFields(timestamp=options.timestamp, camera=options.camera)
    stored = await enrol_look(engine, map_, place_id, data, fields, deadline)
    look = next((one for one in await in_thread(map_.looks, place_id) if one.name == stored.name), None)
    if look is None:
        raise errors.UnknownLook(f"The look {stored.name!r} of place {place_id!r} was removed in the same moment.")
    response.status_code = 201 if stored.change == "created" else 200
    request.state.noted = {"map": map_id, "place": place_id, "look": stored.name, "change": stored.change}
    return AddedLook(
        **look.__dict__,
        place=place_id,
        change=stored.change,
        encoder=map_.record.encoder,
        milliseconds=rounded({**stored.milliseconds, "total": milliseconds_since(started(request))}),
    )


@router.get("/places/{place}/looks", responses=problem_documentation(errors.UnknownPlace))
def list_looks(map_id: MapId, place_id: PlaceId, engine: EngineDep) -> LookPage:
    """List the looks that a place has besides its first, in the order in which they were added; all on one page."""
    looks = engine.maps.get(map_id).looks(place_id)
    return LookPage(items=[_view(place_id, look) for look in looks], next_cursor=None)


@router.get(
    "/places/{place}/looks/{look}/thumbnail",
    response_class=Response,
    responses={**THUMBNAIL, **problem_documentation(errors.UnknownPlace, errors.UnknownLook, errors.NoThumbnail)},
)
def see_look(map_id: MapId, place_id: PlaceId, look: LookName, engine: EngineDep) -> Response:
    """The thumbnail of a look, or a thumbnail of the image that the map keeps."""
    map_ = engine.maps.get(map_id)
    try:
        picture = map_.thumbnail(look_address(place_id, look))
    except errors.UnknownPlace:
        map_.place(place_id)  # raises if it is the place that is unknown
        raise errors.UnknownLook(f"Place {place_id!r} has no look {look!r}.") from None
    return Response(picture, media_type="image/jpeg", headers={"Cache-Control": "no-cache"})


@router.delete(
    "/places/{place}/looks/{look}",
    status_code=204,
    dependencies=[WHOLE_DELETION],
    responses=problem_documentation(errors.UnknownPlace, errors.UnknownLook, errors.StorageFull),
)
def delete_look(map_id: MapId, place_id: PlaceId, look: LookName, request: Request, engine: EngineDep) -> None:
    """Remove a look of a place: no later query finds the place by it."""
    map_ = engine.maps.get(map_id)
    map_.forget_look(place_id, look)
    request.state.noted = {"map": map_id, "place": place_id, "look": look}
    tell_change(engine, map_, "look-removed", 1)


@router.get("/looks", responses=problem_documentation(errors.InvalidCursor))
def list_all_looks(map_id: MapId, page: Annotated[LookPageParameters, Query()], engine: EngineDep) -> LookPage:
    """List the looks of all places in the order in which they were added: all, or those learnt from one run."""
    found, next_cursor = engine.maps.get(map_id).all_looks(page.cursor, page.limit, page.run)
    return LookPage(items=[_view(place_id, look) for place_id, look in found], next_cursor=next_cursor)


def _view(place_id: str, look: Look) -> LookView:
    return LookView.model_construct(place=place_id, **look.__dict__)
