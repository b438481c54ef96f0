"""The feed of a map: what a listener reads, however slowly, is in order, and what it missed is counted."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.frames.images import decode
from core.frames.preprocessing import Pixels
from service.errors.faults import TooManyListeners
from service.events import events as module
from service.events import feed as feeds
from service.events.events import LINGER_SECONDS, Events
from service.events.feed import Feed, FeedEvent, Listener
from service.events.schemas import MapEvent, QueryEvent
from service.fairness import CALLER
from tests.service.scenes import jpeg

pytestmark = pytest.mark.anyio


def add(feed: Feed, count: int = 1, size: int = 10) -> None:
    """Append events whose JSON names their numbers."""
    for _ in range(count):
        text = json.dumps({"number": feed.number + 1, "filler": "x" * size})
        with feed.lock:
            feed.add(FeedEvent(0, "map", None, frozenset({"lab"}), text, text, None))


def numbers(listener: Listener, most: int = 100) -> tuple[int | None, list[int]]:
    """What a listener missed, and the numbers of what it reads."""
    read = listener.read(most)
    return read.missed, [event.number for event in read.events]


async def test_a_listener_begins_now_and_reads_each_event_once() -> None:
    feed = Feed(threading.Lock())
    add(feed, 3)
    listener = Listener(feed, None, False)
    assert numbers(listener) == (0, [])
    add(feed, 2)
    assert numbers(listener, 1) == (0, [4])
    assert numbers(listener) == (0, [5]) and numbers(listener) == (0, [])


async def test_a_listener_that_comes_again_goes_on_after_the_id_that_it_gives() -> None:
    feed = Feed(threading.Lock())
    add(feed, 5)
    assert numbers(Listener(feed, feed.id_of(2), False)) == (0, [3, 4, 5])
    assert numbers(Listener(feed, feed.id_of(0), False)) == (0, [1, 2, 3, 4, 5])


@pytest.mark.parametrize(
    "strange", ["", "-", "x", "x-1", "{epoch}-6", "{epoch}--1", "{epoch}-1e0", "{epoch}-²", "{epoch}-"]
)
async def test_an_id_that_is_not_known_is_answered_with_an_unknown_count(strange: str) -> None:
    feed = Feed(threading.Lock())
    add(feed, 5)
    listener = Listener(feed, strange.format(epoch=feed.epoch), False)
    assert numbers(listener) == (None, [])
    add(feed)
    assert numbers(listener) == (0, [6])


async def test_the_oldest_events_go_by_number_and_by_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feeds, "MOST_EVENTS", 10)
    monkeypatch.setattr(feeds, "MOST_BYTES", 2000)
    feed = Feed(threading.Lock())
    listener = Listener(feed, None, False)
    add(feed, 25)
    assert numbers(listener) == (15, list(range(16, 26)))
    add(feed, 4, size=400)
    assert feed.size <= 2000 and feed.size == sum(event.size for event in feed.latest)
    add(feed, 1, size=5000)
    assert len(feed.latest) == 1, "an event that is larger than the limit is told all the same"
    assert numbers(listener) == (4, [30])


@given(
    st.lists(st.one_of(st.tuples(st.just("add"), st.integers(1, 30)), st.tuples(st.just("read"), st.integers(1, 12))))
)
def test_whatever_the_pace_no_event_is_sent_twice_or_lost_without_a_count(steps: list[tuple[str, int]]) -> None:
    async def run() -> None:
        feed = Feed(threading.Lock())
        add(feed, 3)
        listener = Listener(feed, None, False)
        expected = 4  # the number of the next event
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(feeds, "MOST_EVENTS", 17)
            for what, amount in [*steps, ("read", 1000)]:
                if what == "add":
                    add(feed, amount)
                    continue
                missed, told = numbers(listener, amount)
                assert missed is not None and len(told) <= amount
                assert told == list(range(expected + missed, expected + missed + len(told)))
                expected += missed + len(told)
        assert expected == feed.number + 1

    asyncio.run(run())


def edited(map_id: str = "lab") -> MapEvent:
    return MapEvent.now(map_id, change="edited", revision=2)


async def test_no_event_of_a_map_without_listeners_is_stored() -> None:
    events = Events()
    events.publish(edited())
    assert not events.heard("lab")
    with events.listening("lab") as listener:
        assert events.heard("lab") and not events.heard("yard")
        events.publish(edited())
        events.publish(edited("yard"))
        assert numbers(listener) == (0, [1])


async def test_events_are_stored_for_a_while_after_the_last_listener_has_left() -> None:
    now = 0.0
    events = Events(clock=lambda: now)
    with events.listening("lab") as listener:
        left_at = listener.position
    events.publish(edited())
    with events.listening("lab", left_at) as listener:
        assert numbers(listener) == (0, [1])
    now += LINGER_SECONDS - 1
    events.publish(edited())
    assert events.heard("lab")
    now += 1
    events.publish(edited())
    assert not events.heard("lab")
    with events.listening("lab", left_at) as listener:
        assert numbers(listener) == (None, [])


async def test_listeners_and_the_maps_that_they_left_are_bounded() -> None:
    events = Events(most_listeners=2)
    with events.listening("a"), events.listening("b"):
        assert events.listeners == 2
        with pytest.raises(TooManyListeners), events.listening("c"):
            pass
    for number in range(20):
        with events.listening(f"map-{number}"):
            pass
    assert sum(events.heard(f"map-{number}") for number in range(20)) <= 3
    assert events.listeners == 0


async def test_the_caller_with_most_listeners_gives_way_to_another() -> None:
    events, streams = Events(most_listeners=3), ExitStack()
    with streams:
        greedy = [streams.enter_context(events.listening("lab")) for _ in range(3)]
        with pytest.raises(TooManyListeners), events.listening("lab"):
            pass
        token = CALLER.set("robot")
        with events.listening("lab") as robot:
            assert [listener.over for listener in greedy] == [False, False, True] and events.listeners == 3
            await asyncio.wait_for(greedy[2].changed.wait(), 60)
            assert not robot.over
        CALLER.reset(token)
        streams.enter_context(events.listening("lab"))
    assert events.listeners == 0


async def test_a_listener_is_woken_from_another_thread() -> None:
    events = Events()
    with events.listening("lab") as listener:
        threading.Thread(target=events.publish, args=(edited(),)).start()
        async with asyncio.timeout(30):
            await listener.changed.wait()
        assert numbers(listener) == (0, [1])


async def test_a_deleted_map_ends_its_listeners_after_what_came_before() -> None:
    events = Events()
    with events.listening("lab") as listener:
        events.publish(edited())
        events.end("lab")
        assert not listener.ended and not events.heard("lab")
        assert numbers(listener) == (0, [1])
        assert listener.ended


def asked(camera: str | None = None) -> QueryEvent:
    return QueryEvent.now(
        "lab", operation="query", verdict="unknown", probability=None, place=None, best=None, pose=None, score=None,
        decision=None, threshold=None, reason="empty-map", camera=camera, milliseconds={}, revision=1,
    )  # fmt: skip


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """The sizes of the frames of which pictures are made."""
    sizes: list[int] = []

    def counting(data: bytes, *options: Any) -> Pixels:
        sizes.append(len(data))
        return decode(data, *options)

    monkeypatch.setattr(module, "decode", counting)
    yield sizes


async def test_pictures_are_made_only_for_listeners_who_want_them(drawn: list[int]) -> None:
    events, frame = Events(), jpeg(1)
    with events.listening("lab") as listener:
        events.publish(asked(), frame)
        (event,) = listener.read().events
        assert event.picture is None and drawn == []
        with events.listening("lab", pictures=True) as other:
            events.publish(asked(), frame)
            events.publish(asked(), b"no image at all")
            events.publish(asked(), None)
            found: list[str | None] = []
            async with asyncio.timeout(30):
                while len(found) < 3:
                    await other.changed.wait()
                    other.changed.clear()
                    found += [json.loads(one.data(True, True))["picture"] for one in other.read().events]
            assert len([one for one in found if one is not None and one.startswith("data:image/jpeg;base64,")]) == 1
            assert drawn == [len(frame), len(b"no image at all")]
            assert all("picture" not in json.loads(one.data(True, False)) for one in listener.read().events)
    events.stop_soon()


async def test_frames_whose_pictures_are_being_made_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    gate = threading.Event()

    def held(data: bytes, *options: Any) -> Pixels:
        gate.wait(60)
        return decode(data, *options)

    monkeypatch.setattr(module, "decode", held)
    events, frame = Events(), jpeg(1)
    with events.listening("lab", pictures=True) as listener:
        for _ in range(module.MOST_DRAWING + 5):
            events.publish(asked(), frame)
        told = listener.read().events
        assert len(told) == 5 and all(one.picture is None for one in told)
        gate.set()
        found: list[str | None] = []
        async with asyncio.timeout(30):
            while len(found) < module.MOST_DRAWING:
                await listener.changed.wait()
                listener.changed.clear()
                found += [one.picture for one in listener.read().events]
        assert all(found)
    events.stop_soon()


async def test_callers_are_for_the_eyes_of_higher_roles() -> None:
    events = Events()
    with events.listening("lab") as listener:
        events.publish(asked("front"))
        (event,) = listener.read().events
    full, public = json.loads(event.data(True, False)), json.loads(event.data(False, False))
    assert full.keys() - public.keys() == {"key", "explanation"}
    assert public["camera"] == "front"
