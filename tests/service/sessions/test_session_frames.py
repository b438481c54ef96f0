"""Frames of a session without HTTP: one that fails does not count, and a deleted session stays deleted."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from core.errors import StorageFailure
from core.maps import Map, MapSettings
from core.places import PlaceFields
from service.app.runtime import Runtime
from service.engine.engine import Engine
from service.engine.queue import RequestDeadline
from service.places.enrolment import FrameToEnrol, enrol
from service.sessions.frames import process_frame
from service.sessions.schemas import FrameParameters, NewSession, SessionAnswer
from service.sessions.sessions import Session
from service.settings import Settings
from service.telemetry.metrics import Metrics
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import jpeg

pytestmark = pytest.mark.anyio


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[Runtime]:
    install_coarse_encoder(tmp_path / "models")
    running = Runtime(Settings(data_dir=tmp_path / "data", encoder=COARSE), Metrics())
    yield running
    running.jobs.close(1)
    running.statistics.close()
    running.sessions.close()
    running.engine.close()


def deadline() -> RequestDeadline:
    return RequestDeadline(time.monotonic() + 60, asyncio.Event().wait)  # type: ignore[arg-type]


async def walked(engine: Engine) -> Map:
    """A map of four places."""
    identity = engine.resolve(None)
    encoder = await engine.queue.load(identity)
    made = engine.maps.create("lab", identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    await enrol(engine, made, [FrameToEnrol(f"p{n}", PlaceFields(sequence="a"), jpeg(n)) for n in range(4)], deadline())
    return made


async def send(runtime: Runtime, map_: Map, session: Session, number: int) -> SessionAnswer:
    options = FrameParameters(frame=number)
    parts = runtime.engine, runtime.sessions, runtime.statistics
    return await process_frame(*parts, map_, session, jpeg(number), options, deadline(), None)


@pytest.mark.parametrize("kind", ["bayes", "path"])
async def test_a_frame_whose_answer_fails_does_not_count(
    runtime: Runtime, monkeypatch: pytest.MonkeyPatch, kind: Any
) -> None:
    map_ = await walked(runtime.engine)
    session, other = (runtime.sessions.create(map_, NewSession(filter=kind)) for _ in range(2))
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


async def test_a_session_deleted_during_a_frame_stays_deleted(runtime: Runtime) -> None:
    map_ = await walked(runtime.engine)
    session = runtime.sessions.create(map_, NewSession())
    await send(runtime, map_, session, 0)
    runtime.sessions.delete(session)
    assert not runtime.sessions.save(session), "as the frame does that was under way"
    assert runtime.sessions._store.read(session.id) is None
