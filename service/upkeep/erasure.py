"""The job that erases frames: it deletes places and looks, and then all that has something of what they showed.

It may be chosen by ids, by the conditions of a deletion, or by a robot's session, which is a run.  Frames stored for
review, the latest answers and events go with the places that they are about; then the map is rewritten without
what all of them have left.  A run of which frames were erased teaches its map nothing more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from typing import Any

from core.errors import UnknownFrame
from core.ledger.maps.review import stored_frames
from core.maps import PlaceFilter, ReviewFrame
from core.places import Look, look_address, place_and_look
from core.store import Map
from service.engine.engine import Engine
from service.errors.faults import SessionExpired, UnknownSession
from service.jobs.context import JobContext, yield_to_requests
from service.jobs.jobs import Jobs
from service.learning.new_ground import forget_rejected
from service.learning.run_notes import RunNotes
from service.places.filters import PlaceConditions
from service.places.place_events import tell_change
from service.queries.given_answers import GivenAnswer
from service.queries.pictures import ExplanationPictures
from service.queries.statistics import QueryStatistics, map_key
from service.recordings.uploads import Recordings
from service.sessions.sessions import Sessions

KIND = "erase"

AT_ONCE = 500
"""Places or looks that are deleted in one commit."""


@dataclass(frozen=True)
class Traces:
    """The subjects for which an answer, a look, a run, or a frame stored for review is erased.

    session: the id of a session, which is the name of its run, too.
    after, before: a time; None: any time.
    camera: that took the frame; None: any.  Without a time and a camera no frame goes for either.
    places, looks: ids of erased places, and addresses of erased looks.
    """

    session: str | None
    after: datetime | None
    before: datetime | None
    camera: str | None
    places: frozenset[str] = frozenset()
    looks: frozenset[str] = frozenset()

    @classmethod
    def of(cls, order: Mapping[str, Any]) -> Traces:
        """The traces that the arguments of a job name, less places and looks.

        A time and a camera are those of frames; with a traverse or metadata besides, they are of these places alone.
        """
        given = order["filter"]
        conditions = None if given is None else PlaceConditions.model_validate(given)
        if conditions is None or conditions.sequence is not None or conditions.where is not None:
            return cls(order["session"], None, None, None)
        return cls(order["session"], conditions.after, conditions.before, conditions.camera)

    def are_at(self, moment: datetime | None, camera: str | None) -> bool:
        """Whether a frame of this moment, None if it is unknown, and this camera is erased."""
        if (self.after, self.before, self.camera) == (None, None, None) or self.camera not in (None, camera):
            return False
        if moment is None:
            return self.after is None and self.before is None
        early = self.after is not None and moment < self.after
        late = self.before is not None and moment > self.before
        return not early and not late

    def has_sent(self, frame: ReviewFrame) -> bool:
        """Whether a stored frame itself is erased, whatever place it is about."""
        answer, proposal = frame.answer, _proposal(frame)
        if self.session is not None and self.session in (answer.get("session"), proposal.get("run")):
            return True
        # A proposal is stored when its run is over, which says nothing of its frame.
        told = [proposal["taken"]] if proposal.get("taken") else [frame.at.isoformat(), answer.get("taken")]
        moments = (datetime.fromisoformat(moment) for moment in told if moment is not None)
        return any(self.are_at(moment, answer.get("camera")) for moment in moments)

    def in_review(self, frame: ReviewFrame) -> bool:
        """Whether a stored frame goes."""
        label, look = (frame.label or {}).get("label", {}), look_of(frame)
        named = {frame.answer.get("best"), _proposal(frame).get("place"), label.get("place"), label.get("new")}
        return bool(named & self.places) or look in self.looks or self.has_sent(frame)

    def in_answer(self, given: GivenAnswer) -> bool:
        """Whether an answer goes."""
        if self.session is not None and given.frame.session == self.session:
            return True
        moments = (given.at, given.frame.taken or given.at)
        return given.best in self.places or any(self.are_at(moment, given.frame.camera) for moment in moments)

    def in_look(self, look: Look) -> bool:
        """Whether a look goes, its place or not."""
        return (self.session is not None and look.run == self.session) or self.are_at(look.timestamp, look.camera)

    def in_notes(self, notes: RunNotes, until: datetime | None = None) -> bool:
        """Whether a run goes, because of the frames that were taken until a moment; None: of all of them."""
        if self.session is not None and notes.session == self.session:
            return True
        frames = (one for one in notes.frames.copy() if until is None or one.taken <= until)
        return any(self.are_at(one.taken, _camera(one.answer)) for one in frames)


def _proposal(frame: ReviewFrame) -> Mapping[str, Any]:
    """The words of a run about a frame that it has left for review; none about any other frame."""
    told: Mapping[str, Any] = frame.answer.get("proposal") or frame.answer.get("stretch") or {}
    return told


def _camera(answer: Mapping[str, object]) -> str | None:
    named = answer.get("camera")
    return named if isinstance(named, str) else None


def look_of(frame: ReviewFrame) -> str | None:
    """The address of the look that a stored frame has become; None if it has become none."""
    label = (frame.label or {}).get("label", {})
    return look_address(label["place"], label["look"]) if label.get("look") is not None else None


@dataclass(frozen=True)
class Rooms:
    """The parts of a service that have something of frames, besides the maps."""

    engine: Engine
    statistics: QueryStatistics
    sessions: Sessions
    pictures: ExplanationPictures
    recordings: Recordings


def erase(rooms: Rooms, context: JobContext) -> Mapping[str, Any]:
    """Delete places and all that has something of their frames, and rewrite the map without what is left.

    The ids are noted before anything is deleted, so that an attempt after a restart ends what was begun.

    Raises:
        UnknownMap, MapQuarantined, StorageFull, StorageFailure, MapBusy: the job can be submitted again.
        JobCancelled, JobInterrupted: what was deleted stays so.
    """
    engine, order = rooms.engine, context.arguments
    map_ = context.map(engine.maps)
    traces = Traces.of(order)
    _forget_runs(rooms, map_, traces)  # first, so that none of them leaves anything new
    if "ids" not in context.notes:
        named = order["ids"] or _ids(map_, order["filter"], context)
        looks = [one for one in named if place_and_look(one)[1] is not None]
        looks += _looks(map_, traces, context)
        context.remember(ids=[one for one in named if place_and_look(one)[1] is None], looks=looks)
    ids, addresses = context.notes["ids"], context.notes["looks"]
    ground = _delete_new_ground(rooms, map_, traces)
    places, looks_gone = _delete(rooms, map_, ids, context), _delete_looks(rooms, map_, addresses, context)
    traces = replace(traces, places=frozenset(ids), looks=frozenset(addresses))
    review = _discard(map_, traces, context)
    answers = rooms.statistics.recent.forget(map_key(map_), traces.in_answer)
    rooms.statistics.robots.forget(map_key(map_))
    rooms.pictures.forget(map_key(map_))
    engine.events.forget(map_.record.id)
    context.check_cancelled()

    def advance(done: int, total: int) -> None:
        context.progress(done, total, "erasing")
        yield_to_requests(engine, context)

    report = map_.erase(advance)
    found = {"places": places + ground, "looks": looks_gone, "review": review, "answers": answers}
    return found | report.model_dump() | _bags(rooms.recordings, map_.record.id, order)


def _bags(recordings: Recordings, map_id: str, order: Mapping[str, Any]) -> dict[str, Any]:
    """How many bags the order has removed, and the names of those that could be enrolled later.

    Raises:
        StorageFailure.
    """
    removed = recordings.remove_all(map_id) if order.get("bags", False) else 0
    return {"bags": removed, "waiting_bags": recordings.names(map_id)}


def concerns(jobs: Jobs, map_id: str, made: str, notes: RunNotes) -> bool:
    """Whether frames of a run were erased after they were noted, or are about to be.

    The orders are those that the jobs remember, of all services that share them.

    Args:
        map_id, made: of the map of the run, and when it was created.

    Raises:
        StorageFull, StorageFailure: the jobs cannot be read.
    """
    now = datetime.now(UTC)
    return any(
        Traces.of(job.arguments).in_notes(notes, job.ended_at or now)
        for job in jobs.all()
        if job.kind == KIND and job.maps.get(map_id) == made
        if job.state != "cancelled" or job.started_at is not None
    )


def _ids(map_: Map, given: Mapping[str, Any] | None, context: JobContext) -> list[str]:
    """The ids of all places that fulfil the conditions; without conditions there are none."""
    if given is None:
        return []
    found: list[str] = []
    wanted, cursor = PlaceConditions.model_validate(given).wanted(), None
    while True:
        context.check_cancelled()
        page, cursor = map_.places(cursor, AT_ONCE, wanted)
        found += [place.id for place in page]
        if cursor is None:
            return found


def _looks(map_: Map, traces: Traces, context: JobContext) -> list[str]:
    """The addresses of the looks that go by themselves, those of which people said so in review included."""
    frames = stored_frames(map_.review, look=context.check_cancelled)
    found = {address for one in frames if traces.has_sent(one) and (address := look_of(one)) is not None}
    cursor = None
    while True:
        context.check_cancelled()
        page, cursor = map_.all_looks(cursor, AT_ONCE)
        found |= {look_address(place_id, look.name) for place_id, look in page if traces.in_look(look)}
        if cursor is None:
            return sorted(found)


def _delete(rooms: Rooms, map_: Map, ids: list[str], context: JobContext) -> int:
    count = 0
    for first in range(0, len(ids), AT_ONCE):
        yield_to_requests(rooms.engine, context)
        with rooms.engine.writing(map_.record.id):
            some = PlaceFilter(tuple(ids[first : first + AT_ONCE]))
            gone = rooms.engine.reserve.making_room(partial(map_.forget_all, some, AT_ONCE))
        tell_change(rooms.engine, map_, "deleted", len(gone))
        count += len(gone)
        context.progress(min(first + AT_ONCE, len(ids)), len(ids), "deleting places")
    return count


def _delete_looks(rooms: Rooms, map_: Map, addresses: list[str], context: JobContext) -> int:
    count = 0
    for first in range(0, len(addresses), AT_ONCE):
        yield_to_requests(rooms.engine, context)
        some = addresses[first : first + AT_ONCE]
        with rooms.engine.writing(map_.record.id):
            gone = rooms.engine.reserve.making_room(partial(map_.forget_looks, some))
        tell_change(rooms.engine, map_, "look-removed", gone)
        count += gone
        context.progress(min(first + AT_ONCE, len(addresses)), len(addresses), "deleting looks")
    return count


def _delete_new_ground(rooms: Rooms, map_: Map, traces: Traces) -> int:
    """Delete the places that the run has added to the map, and forget where its rejected ones are."""
    if traces.session is None:
        return 0
    with rooms.engine.writing(map_.record.id):
        gone = rooms.engine.reserve.making_room(partial(map_.forget_new_ground, traces.session))
        rooms.engine.reserve.making_room(partial(forget_rejected, map_, traces.session))
    tell_change(rooms.engine, map_, "deleted", gone)
    return gone


def _forget_runs(rooms: Rooms, map_: Map, traces: Traces) -> None:
    """Drop the notes of runs that are concerned, and end the session that is named."""
    rooms.sessions.forget_notes(map_, traces.in_notes)
    if traces.session is not None:
        rooms.statistics.forget_run_trials(map_key(map_), traces.session)
        try:
            rooms.sessions.erase(rooms.sessions.find(map_, traces.session))
        except UnknownSession:
            pass
        except SessionExpired:
            rooms.sessions.forget(traces.session)


def _discard(map_: Map, traces: Traces, context: JobContext) -> int:
    count = 0
    for frame in stored_frames(map_.review, look=context.check_cancelled):
        if traces.in_review(frame):
            count += discarded(map_, frame.number)
    return count


def discarded(map_: Map, number: int) -> bool:
    """Discard a stored frame; whether it was still there."""
    try:
        map_.review.discard(number)
    except UnknownFrame:
        return False
    return True
