"""Frames of a session without HTTP: one that fails does not count, and a deleted session stays deleted."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import update

from core.errors import StorageFailure
from core.learning import Witness
from core.ledger import Statement
from core.maps import MapSettings
from core.places import PlaceFields, Pose
from core.store import Map
from service.access.audit import ASKER
from service.app.runtime import Runtime
from service.engine.engine import Engine
from service.engine.queue import RequestDeadline
from service.errors.faults import SessionExpired, UnknownSession
from service.learning.run_notes import RunNotes
from service.places.enrolment import FrameToEnrol, enrol
from service.sessions import table as tables
from service.sessions.frames import process_frame
from service.sessions.schemas import FrameParameters, NewSession, SessionAnswer
from service.sessions.session import Session
from service.settings import Settings
from service.telemetry.metrics import Metrics
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import jpeg
from tests.service.sessions.test_session_table import pass_by as shift

pytestmark = pytest.mark.anyio


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=[pytest.mark.postgres, pytest.mark.thorough])])
def runtime(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Runtime]:
    """A service whose sessions are in its data directory, or in PostgreSQL."""
    install_coarse_encoder(tmp_path / "models")
    database = request.getfixturevalue("database") if request.param == "postgresql" else None
    running = Runtime(Settings(data_dir=tmp_path / "data", encoder=COARSE), Metrics(), database)
    yield running
    running.jobs.close(1)
    running.statistics.close()
    running.sessions.close()
    running.engine.close()


def deadline() -> RequestDeadline:
    return RequestDeadline(time.monotonic() + 60, asyncio.Event().wait)  # type: ignore[arg-type]


async def walked(engine: Engine, count: int = 4, metres: float | None = None) -> Map:
    """A map of so many places, which are so far apart along +x if they have poses."""
    identity = engine.resolve(None)
    encoder = await engine.queue.load(identity)
    made = engine.maps.create("lab", identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    poses = [None if metres is None else Pose(x=metres * n, y=0) for n in range(count)]
    fields = [PlaceFields(pose=pose, sequence="a") for pose in poses]
    await enrol(engine, made, [FrameToEnrol(f"p{n}", one, jpeg(n)) for n, one in enumerate(fields)], deadline())
    return made


async def send(runtime: Runtime, map_: Map, session: Session, number: int, **motion: Any) -> SessionAnswer:
    options = FrameParameters(frame=number, **motion)
    parts = runtime.engine, runtime.sessions, runtime.statistics
    return await process_frame(*parts, map_, session, jpeg(number), options, deadline(), None)


@pytest.mark.thorough
async def test_a_frame_whose_answer_fails_does_not_count(runtime: Runtime, monkeypatch: pytest.MonkeyPatch) -> None:
    map_ = await walked(runtime.engine)
    session, other = (runtime.sessions.create(map_, NewSession()) for _ in range(2))
    for number in range(2):
        await send(runtime, map_, session, number)
        await send(runtime, map_, other, number)

    asked = 0

    def fail_once(rows: Any) -> Any:
        nonlocal asked
        asked += 1
        if asked == 2:  # first for the frame alone, then for the belief
            raise StorageFailure("the disk refuses")
        return type(map_).places_at(map_, rows)

    monkeypatch.setattr(map_, "places_at", fail_once)
    with pytest.raises(StorageFailure):
        await send(runtime, map_, session, 2)
    monkeypatch.undo()
    assert (session.number, session.run) == (1, None)

    again, expected = await send(runtime, map_, session, 2), await send(runtime, map_, other, 2)
    assert not again.repeated and (again.frame, again.frames) == (2, 3)
    assert again.candidates[0].place == expected.candidates[0].place
    assert again.candidates[0].probability == pytest.approx(expected.candidates[0].probability, abs=1e-3)


@pytest.mark.parametrize(("ahead", "dated"), [(-timedelta(days=7300), True), (timedelta(days=7300), False)])
async def test_a_time_that_is_no_date_is_not_learnt(runtime: Runtime, ahead: timedelta, dated: bool) -> None:
    """A recording of old is of its time; a frame from the future is of the time at which it came."""
    map_ = await walked(runtime.engine)
    session = runtime.sessions.create(map_, NewSession())
    session.notes = RunNotes(session.id, ASKER.get(), Witness("robot", datetime.now(UTC)))
    session.notable = False
    taken = datetime.now(UTC) + ahead
    answer = await send(runtime, map_, session, 0, timestamp=taken)
    (noted,) = session.notes.frames
    assert (answer.note is None, noted.taken == taken, "taken" in noted.answer) == (dated, dated, dated)
    assert noted.taken <= datetime.now(UTC)


async def test_a_session_deleted_during_a_frame_stays_deleted(runtime: Runtime) -> None:
    map_ = await walked(runtime.engine)
    session = runtime.sessions.create(map_, NewSession())
    await send(runtime, map_, session, 0)
    runtime.sessions.delete(session)
    assert not runtime.sessions.save(session), "as the frame does that was under way"
    assert runtime.sessions._table.head(session.id) is None
    with pytest.raises(UnknownSession):
        await send(runtime, map_, session, 1)


async def test_a_session_expires_without_frames_and_stays_so(runtime: Runtime) -> None:
    map_ = await walked(runtime.engine)
    idle, used = (runtime.sessions.create(map_, NewSession(expires_after=60)) for _ in range(2))
    await send(runtime, map_, idle, 0)
    pass_by(runtime, idle, 61)
    for _ in range(2):
        with pytest.raises(SessionExpired, match="No frame came"):
            runtime.sessions.find(map_, idle.id)
        assert [one.id for one in runtime.sessions.of_map(map_)] == [used.id]
    pass_by(runtime, used, 59)
    await send(runtime, map_, used, 0)
    pass_by(runtime, used, 59)
    assert runtime.sessions.find(map_, used.id) is used, "the last frame counts"


def pass_by(runtime: Runtime, session: Session, seconds: float) -> None:
    """As if the last frame of a session had come so much earlier, by the clock that counts."""
    session.idle_since -= seconds
    shift(runtime.sessions._ledger, session.id, seconds)


async def test_a_damaged_belief_ends_its_session(runtime: Runtime) -> None:
    map_ = await walked(runtime.engine)
    session = runtime.sessions.create(map_, NewSession())
    await send(runtime, map_, session, 0)
    session.run = None  # as after a restart
    damage = Statement(update(tables._TABLE).values(state=b"damaged"))
    assert runtime.sessions._ledger.change("damage", damage) == 1
    for _ in range(2):
        with pytest.raises(SessionExpired, match="damaged"):
            await send(runtime, map_, session, 1)
    assert runtime.sessions.count() == 0 and runtime.sessions.of_map(map_) == []


OK, REQUEST, ANSWER, AGAIN = "ok", "request lost", "answer lost", "answer lost, sent again"


def fates(patterns: int, frames: int) -> list[list[str]]:
    """What happens to each frame of a run: the worst, and some by chance."""
    by_chance = random.Random(4)
    drawn = [by_chance.choices((OK, REQUEST, ANSWER, AGAIN), k=frames) for _ in range(patterns)]
    return [[ANSWER] * frames, [AGAIN] * frames, [REQUEST] * (frames - 1) + [OK], *drawn]


@pytest.mark.thorough
async def test_odometry_counts_once_whatever_is_lost(runtime: Runtime) -> None:
    count, metres = 7, 2.0
    map_ = await walked(runtime.engine, count, metres)
    for pattern in fates(2, count - 1):
        by_pose, expected = (runtime.sessions.create(map_, NewSession(verify="never")) for _ in range(2))
        last: int | None = None
        for number, fate in enumerate([OK, *pattern]):
            if fate == REQUEST:
                continue
            # The odometry's frame is turned by a quarter and begins elsewhere.
            pose = {"odometry_x": 3.0, "odometry_y": metres * number - 8, "odometry_heading": 90.0}
            told = await send(runtime, map_, by_pose, number, **pose)
            if fate == AGAIN:
                again = await send(runtime, map_, by_pose, number, **pose)
                assert again.repeated and again.candidates == told.candidates
            if number == 3:
                by_pose.run = None  # as after a restart of the service: the belief is read from the disk
            motion: dict[str, float] = {} if last is None else {"forward": metres * (number - last)}
            true = await send(runtime, map_, expected, number, **motion)
            last = number
            assert told.motion == true.motion == ("first" if number == 0 else "odometry")
            assert told.unknown == pytest.approx(true.unknown, abs=1e-3), (pattern, number)
            assert told.candidates[0].place == true.candidates[0].place
            assert told.candidates[0].probability == pytest.approx(true.candidates[0].probability, abs=1e-3)
        for session in (by_pose, expected):
            runtime.sessions.delete(session)
