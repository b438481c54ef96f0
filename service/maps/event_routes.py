"""The route of a map's live events."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable
from contextlib import suppress
from typing import Annotated, get_args

from fastapi import APIRouter, Depends, Query, Request
from pydantic import Field
from starlette.responses import Response, StreamingResponse

from core import errors
from core.judgement.verdict import Verdict
from core.store import Map
from service.access.roles import OPERATIONS, Principal, covers
from service.engine.engine import Engine
from service.errors.faults import Fault, InvalidRequest, RoleTooLow, TooManyListeners
from service.errors.problems import problem_documentation
from service.events.feed import FeedEvent, Listener
from service.events.schemas import EventKind, Listening, Missed
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
from service.http.routing import EngineDep, MapId, PrincipalDep, single_values
from service.http.schemas import Parameters
from service.worker_threads import in_thread

GATHER_SECONDS = 0.05
"""A listener gets what happens within this time together."""

router = APIRouter(prefix="/v1/maps/{map}", tags=["maps"], dependencies=[Depends(single_values)])

KINDS: tuple[EventKind, ...] = get_args(EventKind)
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)


class EventParameters(Parameters):
    """Which events of a map a listener wants."""

    kinds: str | None = Field(
        default=None,
        max_length=200,
        description=f"The kinds of events, separated by commas: {', '.join(KINDS)}; all if left out.",
        examples=["query,session"],
    )
    verdicts: str | None = Field(
        default=None,
        max_length=200,
        description=f"Only queries with these verdicts, separated by commas: {', '.join(VERDICTS)}; all if left out. "
        "Events of other kinds are not affected.",
        examples=["ambiguous,unknown"],
    )
    pictures: bool = Field(
        default=False,
        description="Tell queries with a small picture of the frame, if the map keeps pictures of its places. This "
        "needs a key of the role `enrol`.",
    )

    def chosen_kinds(self) -> frozenset[str]:
        """The kinds; raises InvalidRequest if one is unknown."""
        return _among("kinds", self.kinds, KINDS)

    def chosen_verdicts(self) -> frozenset[str]:
        """The verdicts; raises InvalidRequest if one is unknown."""
        return _among("verdicts", self.verdicts, VERDICTS)


def _among(name: str, text: str | None, known: tuple[str, ...]) -> frozenset[str]:
    if text is None:
        return frozenset(known)
    chosen = [one.strip() for one in text.split(",")]
    if strange := [one for one in chosen if one not in known]:
        raise InvalidRequest(f"{name}: {strange[0][:80]!r} is not one of {', '.join(known)}.")
    return frozenset(chosen)


@router.get(
    "/events",
    response_class=StreamingResponse,
    responses={
        200: described(
            "The first is named `listening`, and gives the selection of others. Each other one is named after its "
            "kind; its data is a QueryEvent, EnrolmentEvent, SessionEvent, JobEvent or MapEvent. `missed` says that "
            "events are lost for this listener."
        ),
        **problem_documentation(errors.UnknownMap, errors.MapQuarantined, RoleTooLow, TooManyListeners),
    },
)
async def follow_map(
    map_id: MapId,
    options: Annotated[EventParameters, Query()],
    request: Request,
    engine: EngineDep,
    principal: PrincipalDep,
    last_event_id: LastEventId = None,
) -> Response:
    """Follow what happens in a map by server-sent events: queries, enrolments, sessions, jobs, changes of the map.

    A client that connects again with `Last-Event-ID` goes on where it was; the latest events are stored for two minutes
    after the last listener of the map has left. A listener that reads too slowly, or comes too late, learns how many
    events it has missed. A key of the role `query` does not see the callers. The stream ends when the map is deleted,
    when the key is no longer valid for it, when the service stops, and when another caller needs its place.
    """
    map_ = await engine.map(map_id)
    stream = MapStream(engine, map_, options, lambda: request.app.state.gate.identify(request.scope))
    stream.check(principal)
    request.state.noted = {"map": map_id, "pictures": options.pictures}  # without them, nothing is audited
    return await stream_response(request, stream.texts(last_event_id))


class MapStream:
    """The events of a map for one listener.

    Args:
        identify: who listens, by its key as it is now.
    """

    def __init__(self, engine: Engine, map_: Map, options: EventParameters, identify: Callable[[], Principal]) -> None:
        self._engine, self._map, self._identify = engine, map_, identify
        self._kinds, self._verdicts = options.chosen_kinds(), options.chosen_verdicts()
        self._pictures = options.pictures
        self._head = Listening(
            map=map_.record.id,
            kinds=[kind for kind in KINDS if kind in self._kinds],
            verdicts=None if options.verdicts is None else [one for one in VERDICTS if one in self._verdicts],
            pictures=options.pictures and map_.record.keep != "none",
        )

    def check(self, principal: Principal) -> None:
        """Refuse a caller that may not listen.

        Raises:
            RoleTooLow, MapForbidden.
        """
        principal.require(self._map.record.id)
        needed = "enrol" if self._pictures else OPERATIONS["follow_map"].role
        if not covers(principal.role, needed):
            what = "pictures need" if self._pictures else "events need"
            raise RoleTooLow(f"The key {principal.name!r} has the role {principal.role}; {what} {needed}.")

    async def texts(self, resumed: str | None) -> AsyncGenerator[str]:
        """The text of the stream, until the map is deleted, the caller's key is refused, the service stops, or another
        caller needs the place."""
        with self._engine.events.listening(self._map.record.id, resumed, self._pictures) as listener:
            yield OPENING + event_text(listener.position, "listening", self._head.model_dump_json(ensure_ascii=True))
            while not (self._engine.events.stopping or listener.over):
                principal = self._listening_now()
                if principal is None:
                    return
                text = self._unread(listener, principal)
                if text is not None:
                    if text:
                        yield text
                    continue
                if listener.ended:
                    return
                try:
                    changed = await set_or_refused(listener.changed, HEARTBEAT_SECONDS, self._check_key)
                except Fault:
                    return
                if changed:
                    await asyncio.sleep(GATHER_SECONDS)
                elif await in_thread(self._is_gone):
                    return
                else:
                    yield HEARTBEAT

    def _check_key(self) -> Principal:
        """Who listens; raises a Fault if it may no longer."""
        principal = self._identify()
        self.check(principal)
        return principal

    def _listening_now(self) -> Principal | None:
        """Who listens; None if it may no longer."""
        with suppress(Fault):
            return self._check_key()
        return None

    def _is_gone(self) -> bool:
        """Whether the map was deleted, replaced or found to be damaged."""
        try:
            return self._engine.maps.find(self._map.record.id).record.created_at != self._map.record.created_at
        except errors.StoreUnavailable:
            return False
        except errors.PlacerecError:
            return True

    def _unread(self, listener: Listener, principal: Principal) -> str | None:
        """The text for the listener of the events since it read last; None if there were none."""
        read = listener.read()
        if not read.events and read.missed == 0:
            return None
        private = covers(principal.role, "enrol")
        texts = [
            event_text(listener.id_of(event), event.kind, event.data(private, self._pictures))
            for event in read.events
            if self._wants(event) and principal.may_use(*event.maps)
        ]
        if read.missed != 0:
            missed = Missed(map=self._map.record.id, count=read.missed)
            texts.insert(0, event_text(read.before, "missed", missed.model_dump_json()))
        return "".join(texts)

    def _wants(self, event: FeedEvent) -> bool:
        return event.kind in self._kinds and (event.verdict is None or event.verdict in self._verdicts)
