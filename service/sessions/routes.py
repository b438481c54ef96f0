"""Routes of sessions: create, list, read and delete, and send a frame."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Depends, Path, Query, Request, Response

from core import errors
from core.maps.pagination import Listing, decode_name, page_of
from service.access.roles import Principal, covers
from service.errors.faults import (
    EncoderNotInstalled,
    QueueFull,
    SessionExpired,
    SessionOfAnother,
    TooManySessions,
    UnknownSession,
    UnsupportedMediaType,
)
from service.errors.problems import problem_documentation
from service.http.openapi import frame_body
from service.http.routing import (
    WHOLE_DELETION,
    DeadlineDep,
    EngineDep,
    FromState,
    MapId,
    Page,
    PrincipalDep,
    StrictRoute,
    frame_for_map,
    json_body,
    milliseconds_since,
    rounded,
    single_values,
    started,
)
from service.learning.run_notes import new_notes
from service.queries.answers import StatisticsDep
from service.sessions.frames import process_frame, session_report, session_view
from service.sessions.schemas import FrameParameters, NewSession, SessionAnswer, SessionPage, SessionReport, SessionView
from service.sessions.sessions import Sessions
from service.telemetry.requests import REQUEST_ID
from service.worker_threads import in_thread

SessionsDep = Annotated[Sessions, Depends(FromState("sessions"))]

router = APIRouter(
    prefix="/v1/maps/{map}/sessions",
    tags=["sessions"],
    route_class=StrictRoute,
    dependencies=[Depends(single_values)],
)
SessionId = Annotated[str, Path(alias="session", description="Id of the session.", examples=["s-4f2a9c01d37be586"])]
FrameOptions = Annotated[FrameParameters, Query()]
GONE = problem_documentation(UnknownSession, SessionExpired)
BOUND = GONE | problem_documentation(SessionOfAnother, UnknownSession, SessionExpired)


def _may_see_keys(principal: Principal) -> bool:
    """Whether a caller learns who the others are."""
    return covers(principal.role, "enrol")


@router.post(
    "",
    status_code=201,
    dependencies=[Depends(json_body)],
    responses=problem_documentation(
        UnsupportedMediaType, errors.UnknownSequence, errors.UnknownCamera, TooManySessions, errors.StorageFull
    ),
)
def create_session(
    map_id: MapId,
    new: NewSession,
    engine: EngineDep,
    sessions: SessionsDep,
    principal: PrincipalDep,
    response: Response,
) -> SessionView:
    """Begin a session. It ends when it is deleted, or when no frame has come for `expires_after` seconds."""
    map_ = engine.maps.get(map_id)
    if new.camera is not None:
        map_.cameras.mask(new.camera)
    session = sessions.create(map_, new)
    session.notes, session.notable = new_notes(map_, session.id, principal), False
    response.headers["Location"] = f"{engine.settings.root_path}/v1/maps/{map_id}/sessions/{session.id}"
    return session_view(session, _may_see_keys(principal))


@router.get("", responses=problem_documentation(errors.InvalidCursor))
async def list_sessions(
    map_id: MapId, page: Page, engine: EngineDep, sessions: SessionsDep, principal: PrincipalDep
) -> SessionPage:
    """List the sessions of a map that have not ended."""
    map_ = await engine.map(map_id)
    listing: Listing = ["sessions-of", map_id]
    after = decode_name(listing, page.cursor)
    found = [session for session in await in_thread(sessions.of_map, map_) if session.id > after]
    shown, more = page_of(listing, found, page.limit, lambda session: session.id)
    private = _may_see_keys(principal)
    return SessionPage(items=[session_view(session, private) for session in shown], next_cursor=more)


@router.get("/{session}", responses=GONE)
async def read_session(
    map_id: MapId, session_id: SessionId, engine: EngineDep, sessions: SessionsDep, principal: PrincipalDep
) -> SessionReport:
    """Read a session and the present belief about where its robot is."""
    map_ = await engine.map(map_id)
    session = await in_thread(sessions.find, map_, session_id)
    async with session.turn():
        return await in_thread(session_report, sessions, map_, session, _may_see_keys(principal))


@router.delete("/{session}", status_code=204, dependencies=[WHOLE_DELETION], responses=BOUND)
async def delete_session(
    map_id: MapId, session_id: SessionId, engine: EngineDep, sessions: SessionsDep, principal: PrincipalDep
) -> None:
    """Delete a session: its run is over. Besides the key that began it, keys of the role `admin` may."""
    map_ = await engine.map(map_id)
    session = await in_thread(sessions.find, map_, session_id)
    session.require(principal, ending=True)
    await in_thread(engine.reserve.making_room, partial(sessions.delete, session))


@router.post(
    "/{session}/frames",
    openapi_extra=frame_body(FrameParameters),
    responses=BOUND
    | problem_documentation(
        errors.UnknownCamera,
        UnknownSession,
        errors.WrongEncoder,
        errors.FrameOutOfOrder,
        errors.TooManyPixels,
        UnsupportedMediaType,
        errors.NotAnImage,
        errors.TruncatedImage,
        QueueFull,
        EncoderNotInstalled,
    ),
)
async def send_frame(
    map_id: MapId,
    session_id: SessionId,
    options: FrameOptions,
    request: Request,
    engine: EngineDep,
    sessions: SessionsDep,
    statistics: StatisticsDep,
    principal: PrincipalDep,
    deadline: DeadlineDep,
) -> SessionAnswer:
    """Send one frame of a session that this key has begun, and learn where the robot is.

    The answer is the belief after the frame; `single` has the answer to the frame alone. A frame that is sent again,
    with the same `frame` number or, without one, with the same `X-Request-Id`, counts once and gets the same answer.
    A frame that is answered with a problem does not count.
    """
    engine.queue.check_room()
    session = await in_thread(sessions.find, await engine.map(map_id), session_id)  # fails before the body is read
    session.require(principal)
    map_, data, options = await frame_for_map(request, engine, map_id, options)
    given = request.headers.get("x-request-id", "")
    given_id = given if REQUEST_ID.fullmatch(given) else None
    answer = await process_frame(
        engine, sessions, statistics, map_, session, data, options, deadline, given_id, principal
    )
    answer.milliseconds |= rounded({"total": milliseconds_since(started(request))})
    request.state.noted = {"map": map_id, "session": session_id, "verdict": answer.verdict}
    return answer
