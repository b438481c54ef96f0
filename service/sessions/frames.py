"""One frame of a session: it is encoded and located alone, the belief is updated, and both are answered."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from core.belief import (
    NOTHING,
    Candidate,
    Contradiction,
    Estimate,
    Evidence,
    Run,
    Step,
    View,
    agreement,
    evidence_of,
    view_of,
)
from core.clocks import Interval, future, interval
from core.errors import FrameOutOfOrder
from core.judgement.change import WorldChange
from core.learning import RunFrame
from core.maps.selection import Selection
from core.recognition.question import Question
from core.recognition.recognition import Answer
from core.recognition.stages import neighborhood_of
from core.store import Map
from service.access.audit import ASKER
from service.access.roles import ANONYMOUS, Principal
from service.engine.engine import Engine
from service.engine.queue import RequestDeadline
from service.errors.faults import InvalidRequest
from service.events.schemas import SessionEvent
from service.http.routing import rounded
from service.learning.run_notes import NotedFrame, new_notes
from service.places.schemas import PlaceView
from service.queries.answers import answer_of
from service.queries.counts import PassedBy
from service.queries.following import follow_answer
from service.queries.given_answers import GivenAnswer, QueriedFrame
from service.queries.parameters import QueryParameters
from service.queries.schemas import ChangeView, QueryAnswer
from service.queries.statistics import QueryStatistics
from service.sessions.schemas import (
    BeliefView,
    BelievedPlace,
    EarlierBelief,
    FrameParameters,
    Motion,
    SessionAnswer,
    SessionReport,
    SessionView,
)
from service.sessions.session import Session
from service.sessions.sessions import SessionMoved, Sessions, alive_rows
from service.worker_threads import in_thread

SURELY_THERE = 0.95
"""A run passes a place if it is this probable that the robot is there."""

log = logging.getLogger("placerec.sessions")


async def process_frame(
    engine: Engine,
    sessions: Sessions,
    statistics: QueryStatistics,
    map_: Map,
    session: Session,
    data: bytes,
    options: FrameParameters,
    deadline: RequestDeadline,
    request_id: str | None,
    principal: Principal = ANONYMOUS,
) -> SessionAnswer:
    """Process one frame of a session, after the frames that came before it.

    If an error is raised, the frame does not count: the session goes on as if the frame had not come.

    Args:
        data: the bytes of a JPEG, PNG or WebP file.
        request_id: the id that the client gave the request; a frame without a number that comes again with the same
            id is the same frame.
        principal: who sends it.

    Raises:
        FrameOutOfOrder: a later frame was processed already; not if the robot's clock or counter was set meanwhile.
        InvalidRequest: the frame lacks a parameter that the session needs, or has one that it cannot use.
        WrongEncoder: the map is bound to another encoder than ``options.encoder``.
        UnknownSession, SessionExpired: the session ended while the frame waited.
        Others: see ``Engine.ask``.
    """
    began = time.monotonic()
    engine.assert_encoder(map_, options.encoder)
    _check_options(session, options)
    async with session.turn():
        run = await in_thread(_found_run, sessions, map_, session)
        if (repeated := _repeated(session, options, request_id)) is not None:
            return repeated
        since = _since_last(session, options)
        session.receive(ASKER.get())
        selection = session.selection
        if options.level is not None:
            selection = (selection or Selection()).at_level(options.level)
        question = Question(options.k, selection, session.options.verify, session.options.camera)
        answered = await engine.ask(map_, data, question, deadline)
        asked = _question(session, options)
        distrust = _distrust(options.timestamp)
        taken = options.timestamp if distrust is None else None
        queried = QueriedFrame(session.options.camera, session.id, options.frame, asked, taken)
        single = answer_of(map_, answered.frame, answered.answer, statistics.usual(map_))
        try:
            view = await in_thread(view_of, answered.frame.pixels, answered.frame.mask)
            while True:
                try:
                    answer, seen = await in_thread(
                        _advance, sessions, map_, session, run, answered.answer, view, single, options, since, distrust,
                        request_id, began,
                    )  # fmt: skip
                    break
                except SessionMoved:  # the frame comes after the one that another service has processed
                    run = await in_thread(_found_run, sessions, map_, session)
                    if (repeated := _repeated(session, options, request_id)) is not None:
                        return repeated
                    since = _since_last(session, options)
        except Exception:
            session.run = None  # the next frame restores the run as it was saved after the frame before
            raise
        if session.notable:  # it began at another service, or before a restart
            session.notes, session.notable = new_notes(map_, session.id, principal), False
        if session.notes is not None:
            given = GivenAnswer.of(single, queried, run=answer.verdict)
            await in_thread(_note, sessions, session, run, map_, data, options, answered.answer, seen, given)
    total = {"total": answer.milliseconds["total"]}
    follow_answer(
        engine, statistics, map_, single, data, queried,
        milliseconds=total, passed=_passed(answer), run=answer.verdict,
    )  # fmt: skip
    if answer.motion == "contradicted" and answer.contradiction is not None:
        engine.metrics.contradicted.labels(answer.contradiction).inc()
    tell_belief(engine, map_, session, answer)
    return answer


def _passed(answer: SessionAnswer) -> PassedBy | None:
    """The place that a robot was sure to be at with a frame that counts; None if it was not."""
    if answer.place is None or answer.view is not None or (answer.probability or 0.0) < SURELY_THERE:
        return None
    return PassedBy(answer.place.id, answer.single.verdict != "recognized")


def tell_belief(engine: Engine, map_: Map, session: Session, answer: SessionAnswer) -> None:
    """Tell the listeners of a map, if it has any, where a session's robot is believed to be after a frame."""
    if not engine.events.heard(map_.record.id):
        return
    event = SessionEvent.now(
        map_.record.id,
        session=session.id,
        change="moved",
        camera=session.options.camera,
        frame=answer.frame,
        frames=answer.frames,
        verdict=answer.verdict,
        probability=answer.probability,
        unknown=answer.unknown,
        lost=answer.lost,
        place=None if answer.place is None else answer.place.id,
        pose=None if answer.place is None else answer.place.pose,
        motion=answer.motion,
        contradiction=answer.contradiction,
        contradiction_note=answer.contradiction_note,
        world=None if answer.change is None else answer.change.model_dump(),
    )
    engine.events.publish(event)


def _found_run(sessions: Sessions, map_: Map, session: Session) -> Run:
    """The run of a session; raises if the session was deleted while this frame waited."""
    sessions.find(map_, session.id)
    return sessions.run(map_, session)


def _check_options(session: Session, options: FrameParameters) -> None:
    if session.options.speed_limit is not None and options.timestamp is None:
        raise InvalidRequest("timestamp: the session has a speed limit, so every frame needs a timestamp.")


def _repeated(session: Session, options: FrameParameters, request_id: str | None) -> SessionAnswer | None:
    """The stored answer if this frame is the last frame sent again, else None.

    Raises:
        FrameOutOfOrder: it is, and its answer is gone.
    """
    number, last = options.frame, session.number
    again = number == last if number is not None and last is not None else False
    if number is None and request_id is not None:
        again = request_id == session.request
    if again:
        if session.answer is None:
            raise FrameOutOfOrder("The frame was processed already, and its answer is gone: go on with the next one.")
        return SessionAnswer.model_validate_json(session.answer).model_copy(update={"repeated": True})
    return None


def _since_last(session: Session, options: FrameParameters) -> Interval:
    """The time since the last frame.

    Raises:
        FrameOutOfOrder: the frame comes before the last one.
    """
    return interval(session.stamp, options.stamp(), session.idle)


def _distrust(taken: datetime | None) -> str | None:
    """The remark on a frame's time that is no date, because it is far ahead of this machine's clock; None on others."""
    told = None if taken is None else future(taken.timestamp(), time.time())
    return None if told is None else f"The frame's time {told}: it counts within the run alone."


def _advance(
    sessions: Sessions,
    map_: Map,
    session: Session,
    run: Run,
    answered: Answer,
    view: View,
    single: QueryAnswer,
    options: FrameParameters,
    since: Interval,
    distrust: str | None,
    request_id: str | None,
    began: float,
) -> tuple[SessionAnswer, Evidence]:
    """Update the belief, save the session, and answer; also with what the frame alone said."""
    started = time.perf_counter()
    before = run.contradiction
    step, motion = _step(session, run, options, since)
    seen = NOTHING if answered.blank else evidence_of(answered, neighborhood_of(map_))
    run.advance(seen, step, view, options.odometry_pose(), options.storey())
    if run.contradiction is not None and before is None:
        log.warning("session %s goes on without odometry: %s", session.id, run.contradiction.note)
    alive = alive_rows(map_)
    found = run.estimate(options.k, alive)
    earlier = run.earlier(options.k, alive)
    lost = session.lost
    counted = options.frame is not None and session.number is not None and not since.jumps
    if counted and session.restored and lost is None:
        lost = since.frames - 1
    notes = [*since.jumps, "So the motion since the last frame is not known."] if since.jumps else []
    if notes:
        log.warning("session %s: %s", session.id, " ".join(notes))
    if distrust is not None:
        notes.append(distrust)
    answer = SessionAnswer(
        session=session.id,
        frame=options.frame,
        frames=run.frames,
        **belief_view(map_, run, found).__dict__,
        change=_change(run, found, answered, single),
        earlier=None
        if earlier is None
        else EarlierBelief(
            frames_ago=session.options.lag,
            verdict=earlier.verdict,
            candidates=_believed(map_, earlier.candidates),
        ),
        motion="contradicted" if motion == "odometry" and run.contradiction is not None else motion,
        **_contradiction(run.contradiction),
        note=" ".join(notes) or None,
        view=run.sight,
        restored=session.restored,
        frames_lost=lost,
        saved=True,
        single=single,
        milliseconds={},
    )
    believed = 1e3 * (time.perf_counter() - started)
    answer.milliseconds = rounded({"belief": believed, "total": 1e3 * (time.monotonic() - began)})
    # The session changes only here, after everything that may fail: a frame that raises does not count.
    session.answer, session.lost, session.frames = answer.model_dump_json(), lost, run.frames
    session.request = request_id
    session.touch()
    stamp = options.stamp()
    if stamp.number is not None:
        session.number = stamp.number
    if stamp.moment is not None:
        session.moment = stamp.moment
    answer.saved = sessions.save(session)
    answer.milliseconds |= rounded({"save": 1e3 * (time.perf_counter() - started) - believed})
    return answer, seen


def _contradiction(found: Contradiction | None) -> dict[str, Any]:
    """The fields that say what is wrong with odometry."""
    if found is None:
        return {"contradiction": None, "contradiction_note": None}
    return {"contradiction": found.kind, "contradiction_note": found.note}


def _change(run: Run, found: Estimate, answered: Answer, single: QueryAnswer) -> ChangeView | None:
    """The change that a frame shows, by the run; None for one that shows hardly anything."""
    alone = single.change
    if alone is None or run.sight == "covered":
        return None
    agreed = agreement(found, int(answered.candidates.rows[0]), run.graph)
    return ChangeView.of(WorldChange(alone.known, alone.changed, alone.new).during(found.unknown, agreed))


def _note(
    sessions: Sessions,
    session: Session,
    run: Run,
    map_: Map,
    data: bytes,
    options: FrameParameters,
    answered: Answer,
    seen: Evidence,
    given: GivenAnswer,
) -> None:
    """Note a frame for what the map learns from the run; a run to which another key sends frames teaches nothing."""
    notes = session.notes
    if notes is None or session.visited:
        session.notes = None
        return
    rows = answered.candidates.rows
    judgement = answered.judgement
    frame = RunFrame(
        seen, judgement.verdict, judgement.probability, int(rows[0]) if len(rows) else None,
        options.odometry_pose() if run.contradiction is None else None, run.sight,
    )  # fmt: skip
    if run.contradiction is not None:
        notes.drop_odometry()
    taken = given.frame.taken or given.at
    told = given.for_review(given.event(map_.record.id))
    if not notes.add(NotedFrame(frame, data, taken, told)):
        log.warning("session %s teaches its map nothing: the notes of runs have no room", session.id)
        session.notes = None
    elif notes.full:
        session.notes = notes.continued()
        sessions.on_run(session, notes)


def _step(session: Session, run: Run, options: FrameParameters, since: Interval) -> tuple[Step, Motion]:
    """The robot's motion since the last frame, and what it is known from."""
    if not run.frames:
        return Step(), "first"
    if since.jumps:
        return Step(known=False), "sequence"
    odometry, pose, limit = options.odometry(), options.odometry_pose(), session.options.speed_limit
    if pose is not None:
        odometry = run.moved_to(pose, since.seconds, limit)
    reach = None if limit is None or since.seconds is None else limit * since.seconds
    motion: Motion = "sequence"
    if run.graph.posed.any():
        motion = "odometry" if odometry is not None else "speed-limit" if reach is not None else motion
    return Step(odometry, reach, since.frames), motion


def _believed(map_: Map, candidates: Sequence[Candidate]) -> list[BelievedPlace]:
    places = map_.places_at([candidate.row for candidate in candidates]) if candidates else []
    present = [(one.probability, place) for one, place in zip(candidates, places, strict=True) if place is not None]
    return [
        BelievedPlace(rank=rank, probability=probability, place=PlaceView.of(place))
        for rank, (probability, place) in enumerate(present, start=1)
    ]


def belief_view(map_: Map, run: Run, found: Estimate) -> BeliefView:
    """The JSON view of an estimate; places that were deleted in the meantime are left out."""
    candidates = _believed(map_, found.candidates)
    has_best = bool(candidates) and found.candidates[0].probability == candidates[0].probability
    verdict = "ambiguous" if found.verdict == "recognized" and not has_best else found.verdict
    return BeliefView(
        verdict=verdict,
        place=candidates[0].place if verdict == "recognized" else None,
        probability=candidates[0].probability if candidates else None,
        unknown=found.unknown,
        lost=run.lost,
        candidates=candidates,
    )


def _question(session: Session, frame: FrameParameters) -> dict[str, Any]:
    """The parameters of a query that asks what each frame of a session does."""
    given: dict[str, Any] = session.options.model_dump(include={"verify", "camera"}, exclude_none=True)
    if session.options.sequences is not None:
        given["sequences"] = json.dumps(session.options.sequences)
    usual = QueryParameters().model_dump()
    return {
        name: value for name, value in {**given, "k": frame.k, "level": frame.level}.items() if value != usual[name]
    }


def session_view(session: Session, private: bool) -> SessionView:
    """The JSON view of a session, as it is listed; its key is only for those who may see what is ``private``."""
    came = session.last_frame_came
    options = session.options.model_dump()
    return SessionView(
        **{**options, "expires_after": session.expires_after},
        id=session.id,
        map=session.map_id,
        created_at=datetime.fromtimestamp(session.created, UTC),
        expires_at=datetime.fromtimestamp(session.expires, UTC),
        frames=session.frames,
        last_frame=session.number,
        last_frame_at=None if came is None else datetime.fromtimestamp(came, UTC),
        key=session.key if private else None,
        restored=session.restored,
        frames_lost=session.lost,
        **_contradiction(session.contradiction),
        teaches_nothing=None if session.notes is None else session.notes.teaches_nothing,
    )


def session_report(sessions: Sessions, map_: Map, session: Session, private: bool, k: int = 5) -> SessionReport:
    """The JSON view of a session with its present belief; call it in the session's turn, in a thread."""
    run = sessions.run(map_, session)
    found = run.look(k, alive_rows(map_))
    view = session_view(session, private)
    return SessionReport(**view.model_dump(), belief=belief_view(map_, run, found))
