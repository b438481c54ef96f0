"""Routes of review: list the stored frames, see them, label them, export the labels."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query
from pydantic import Field
from starlette.responses import Response

from core import errors
from core.frames.containers import read_header
from core.maps.pagination import Listing, decode_number, page_of
from core.places import PlaceFields, check_place_id, look_address
from core.store import Map
from service.access.audit import ASKER
from service.engine.engine import Engine, camera_mask
from service.engine.queue import RequestDeadline
from service.errors.faults import EncoderNotInstalled, PlaceTaken, QueueFull, TooManyPlaces, UnsupportedMediaType
from service.errors.problems import problem_documentation
from service.http.openapi import BINARY
from service.http.routing import DeadlineDep, EngineDep, MapId, StrictRoute, json_body, single_values
from service.http.schemas import PageParameters
from service.http.uploads import FORMATS
from service.places.enrolment import FrameToEnrol, LookOrigin, digest_of, enrol, enrol_look
from service.places.schemas import PlaceView
from service.review.labels import withdraw_contradicted
from service.review.schemas import (
    ExportedLabel,
    Labelled,
    LabelList,
    LabelOrder,
    NewPlace,
    ReviewFrameView,
    ReviewLabel,
    ReviewPage,
)
from service.worker_threads import in_thread

router = APIRouter(
    prefix="/v1/maps/{map}/review",
    tags=["review"],
    route_class=StrictRoute,
    dependencies=[Depends(single_values)],
)
FrameNumber = Annotated[int, Path(alias="frame", ge=1, le=2**53, description="Id of the stored frame.", examples=[17])]


class ReviewPageParameters(PageParameters):
    """The selection of stored frames."""

    labelled: bool | None = Field(default=None, description="Only frames with a label, or only those without one.")


@router.get("", responses=problem_documentation(errors.InvalidCursor))
def list_review(map_id: MapId, page: Annotated[ReviewPageParameters, Query()], engine: EngineDep) -> ReviewPage:
    """List the frames that a map has stored for review, the newest first.

    A map keeps frames whose answers have the verdicts that its setting `review` names, from a moment after the answer
    on; by default it keeps none.
    """
    map_ = engine.maps.get(map_id)
    listing: Listing = ["review-of", map_id, str(page.labelled)]
    before = decode_number(listing, page.cursor)
    found = map_.review.page(None if before < 0 else before, page.limit + 1, page.labelled)
    shown, more = page_of(listing, found.frames, page.limit, lambda one: one.number)
    items = [ReviewFrameView.of(one) for one in shown]
    _forget_gone_looks(map_, [view.label for view in items if view.label is not None])
    return ReviewPage(items=items, next_cursor=more, frames=found.count, bytes=found.size)


def _forget_gone_looks(map_: Map, labels: list[ReviewLabel]) -> None:
    """Leave the look out of labels where it was undone, withdrawn or deleted since; they still say the place."""
    named = [one for one in labels if one.place is not None and one.look is not None]
    rows = map_.rows_of([look_address(str(one.place), str(one.look)) for one in named])
    for label, row in zip(named, rows, strict=True):
        if row is None:
            label.look = None


@router.get("/labels")
def export_labels(map_id: MapId, engine: EngineDep) -> LabelList:
    """Export the labels of the stored frames: for each the place that it shows, or null if the map has none."""
    return LabelList(
        items=[
            ExportedLabel(
                id=view.id,
                at=view.at,
                sha256=view.sha256,
                camera=view.answer["camera"],
                verdict=view.answer["verdict"],
                place=view.label.place or view.label.new,
                enrolled=view.label.new is not None,
                labelled_at=view.labelled_at,
                labelled_by=view.labelled_by,
            )
            for view in map(ReviewFrameView.of, engine.maps.get(map_id).review.labelled())
            if view.label is not None and view.labelled_at is not None
        ]
    )


@router.get(
    "/{frame:int}/picture",
    response_class=Response,
    responses={
        200: {"description": "The file as it was sent.", "content": {kind: {"schema": BINARY} for kind in FORMATS}},
        **problem_documentation(errors.UnknownFrame),
    },
)
def see_review_picture(map_id: MapId, number: FrameNumber, engine: EngineDep) -> Response:
    """See a frame stored for review."""
    data = engine.maps.get(map_id).review.picture(number)
    kinds = {found: kind for kind, found in FORMATS.items()}
    return Response(data, media_type=kinds[read_header(data).format], headers={"Cache-Control": "private, no-cache"})


@router.post(
    "/{frame:int}",
    dependencies=[Depends(json_body)],
    responses=problem_documentation(
        errors.UnknownFrame,
        errors.UnknownPlace,
        errors.UnknownCamera,
        errors.InvalidField,
        errors.NoRegions,
        errors.RepeatedLook,
        errors.LookNameTaken,
        errors.TooManyLooks,
        errors.StorageFull,
        PlaceTaken,
        TooManyPlaces,
        QueueFull,
        UnsupportedMediaType,
        EncoderNotInstalled,
    ),
)
async def label_frame(
    map_id: MapId, number: FrameNumber, order: LabelOrder, engine: EngineDep, deadline: DeadlineDep
) -> Labelled:
    """Label a stored frame: a place of the map, a new place as which it is enrolled, or no place of the map.

    With `"look": true` it is also added to the looks of the place. Or take its label back, or throw the frame away. A
    label that is given again replaces the one before; enrolled places and looks stay, but for a look that the map had
    taken by itself as another place than the label says: it is withdrawn. Labels serve to calibrate the
    map, with the method `labels`. Simultaneous labels of one frame are applied one after the other.
    """
    map_ = await engine.map(map_id)
    async with engine.review_keeper.turn(map_, number):
        return await _label(engine, map_, number, order, deadline)


async def _label(engine: Engine, map_: Map, number: int, order: LabelOrder, deadline: RequestDeadline) -> Labelled:
    if order.discard:
        await in_thread(engine.reserve.making_room, partial(map_.review.discard, number))
        return Labelled(id=number, discarded=True, frame=None, enrolled=None)
    if order.clear:
        frame = await in_thread(map_.review.label, number, None)
        return Labelled(id=number, discarded=False, frame=ReviewFrameView.of(frame), enrolled=None)
    if order.new is not None:
        with map_.review.held(number):
            enrolled = await _enrol(engine, map_, number, order.new, deadline)
            return await _store(engine, map_, number, {"new": order.new.id}, enrolled)
    label: dict[str, Any] = {"stranger": True}
    if order.place is not None:
        check_place_id(order.place)
        await in_thread(map_.place, order.place)
        label = {"place": order.place}
        if order.look:
            with map_.review.held(number):
                label["look"] = await _add_look(engine, map_, number, order.place, deadline)
                return await _store(engine, map_, number, label)
    return await _store(engine, map_, number, label)


async def _store(
    engine: Engine, map_: Map, number: int, label: dict[str, Any], enrolled: PlaceView | None = None
) -> Labelled:
    asker = ASKER.get()
    said = {"label": label, "at": datetime.now(UTC).isoformat(), "by": asker.principal if asker.key else None}
    before = await in_thread(map_.review.find, number)
    await in_thread(withdraw_contradicted, engine, map_, before.label, label)
    frame = await in_thread(map_.review.label, number, said)
    await in_thread(withdraw_contradicted, engine, map_, frame.replaced, label)  # it may be of this very moment
    return Labelled(id=number, discarded=False, frame=ReviewFrameView.of(frame), enrolled=enrolled)


async def _add_look(engine: Engine, map_: Map, number: int, place_id: str, deadline: RequestDeadline) -> str:
    """Add a stored frame to the looks of a place, with the time and the camera of its query; returns the look's name.

    A proposal for this place that a map has learnt becomes a learnt look.

    Raises:
        UnknownFrame, and what ``enrol_look`` raises.
    """
    stored = await in_thread(map_.review.find, number)
    data = await in_thread(map_.review.picture, number)
    proposal, origin = stored.answer.get("proposal"), LookOrigin()
    taken: datetime | None = stored.at
    if proposal is not None:
        taken = None if proposal["taken"] is None else datetime.fromisoformat(proposal["taken"])
        if proposal["place"] == place_id:
            origin = LookOrigin(proposal["run"], proposal["least_score"])
    fields = PlaceFields(timestamp=taken, camera=stored.answer.get("camera"))
    return (await enrol_look(engine, map_, place_id, data, fields, deadline, origin)).name


async def _enrol(engine: Engine, map_: Map, number: int, new: NewPlace, deadline: RequestDeadline) -> PlaceView:
    """Enrol a stored frame; that again with the same id changes nothing but the fields.

    Raises:
        UnknownFrame, PlaceTaken, and what ``enrol`` raises.
    """
    check_place_id(new.id)
    fields = new.fields(new.metadata, engine.settings)
    data = await in_thread(map_.review.picture, number)
    frame = FrameToEnrol(new.id, fields, data, await camera_mask(map_, fields.camera))
    known = await in_thread(map_.digest, new.id)
    if known is not None and known != await in_thread(digest_of, frame):
        raise PlaceTaken(f"The place {new.id!r} has another frame; choose another id.")
    return PlaceView.of((await enrol(engine, map_, [frame], deadline))[0].place)
