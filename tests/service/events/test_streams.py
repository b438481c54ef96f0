"""The stream of a map's events, read at any pace."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from core.maps import MapSettings
from service.access.roles import OWNER
from service.errors.faults import KeyRefused
from service.events.feed import MOST_EVENTS
from service.events.schemas import MapEvent
from service.http.event_stream import set_or_refused
from service.maps.event_routes import EventParameters, MapStream
from tests.service.engines import ENCODER, runtime_at
from tests.service.events.listening import events_of

pytestmark = pytest.mark.anyio


async def test_a_listener_that_does_not_read_delays_nobody_and_learns_what_it_missed(tmp_path: Path) -> None:
    with runtime_at(tmp_path) as runtime:
        engine = runtime.engine
        map_ = engine.maps.create("lab", ENCODER, 8, MapSettings())
        texts = MapStream(engine, map_, EventParameters(), lambda: OWNER).texts(None)
        heard = list(events_of((await anext(texts)).splitlines()))
        for number in range(MOST_EVENTS + 500):
            engine.events.publish(MapEvent.now("lab", change="edited", revision=number))
        engine.events.end("lab")
        async for text in texts:
            heard += events_of(text.splitlines())
    names = [one.name for one in heard]
    assert names == ["listening", "missed", *["map"] * MOST_EVENTS]
    assert heard[1].data["count"] == 500
    assert [one.data["revision"] for one in heard[2:]] == list(range(500, MOST_EVENTS + 500))
    numbers = [int(one.id.rpartition("-")[2]) for one in heard]
    assert numbers == [0, *range(500, MOST_EVENTS + 501)], "who resumes after 'missed' misses nothing more"


async def test_every_event_is_one_line_of_json_whatever_it_says(tmp_path: Path) -> None:
    strange = "one\ntwo\r\n\r\ndata: three\u2028four\x85 </script> \u0000"
    with runtime_at(tmp_path) as runtime:
        map_ = runtime.engine.maps.create("lab", ENCODER, 8, MapSettings())
        texts = MapStream(runtime.engine, map_, EventParameters(), lambda: OWNER).texts(None)
        await anext(texts)
        runtime.engine.events.publish(MapEvent.now("lab", change="edited", fields=[strange], revision=1))
        text = await anext(texts)
        await texts.aclose()
    assert text.splitlines() == text.split("\n")[:-1], "whatever a client takes for the end of a line"
    assert [line.partition(":")[0] for line in text.split("\n")] == ["id", "event", "data", "", ""]
    (event,) = events_of(text.splitlines())
    assert event.data["fields"] == [strange]


async def test_the_key_of_who_waits_is_looked_at_long_before_anything_happens() -> None:
    looks: list[None] = []

    def check() -> None:
        looks.append(None)
        if len(looks) == 2:
            raise KeyRefused("It was revoked.")

    with pytest.raises(KeyRefused):
        await set_or_refused(asyncio.Event(), 3600.0, check)
    changed = asyncio.Event()
    changed.set()
    assert await set_or_refused(changed, 3600.0, check) and not changed.is_set()
    assert not await set_or_refused(changed, 0.0, check)
