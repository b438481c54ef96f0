"""The encoder's queue: it is bounded, keeps deadlines, drops frames of clients that left, and never blocks the loop."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from contextvars import copy_context
from statistics import median
from typing import Any, TypeVar

import httpx
import pytest

from core.errors import NotAnImage
from core.frames.images import Limits
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from service.engine.encoders import Encoded
from service.engine.queue import EncoderQueue, RequestDeadline
from service.errors.faults import ClientGone, DeadlineExceeded, EncoderNotInstalled, QueueFull
from service.fairness import CALLER
from service.telemetry.metrics import Metrics
from tests.service.engine.busy import keep_busy
from tests.service.scenes import encoded, jpeg, scene
from tests.service.server import Server, assert_problem

pytestmark = pytest.mark.anyio
Made = TypeVar("Made")
IDENTITY = EncoderCatalogue().resolve(DEFAULT_ENCODER)


async def stays() -> None:
    """A caller who does not hang up."""
    await asyncio.Event().wait()


def deadline(seconds: float = 30) -> RequestDeadline:
    return RequestDeadline(time.monotonic() + seconds, stays)


@pytest.fixture
async def queue() -> AsyncIterator[EncoderQueue]:
    made = EncoderQueue(EncoderCatalogue(), Limits(), queue_length=2, threads=0, metrics=Metrics())
    await made.load(IDENTITY)
    yield made
    made.close()


@pytest.fixture
def busy(queue: EncoderQueue) -> Iterator[threading.Event]:
    """The encoder's threads are at work until the event is set."""
    _, done = keep_busy(queue.encoders, queue._loaded[IDENTITY])
    yield done
    done.set()


def frames_encoded(queue: EncoderQueue) -> float:
    return queue._metrics.registry.get_sample_value("placerec_encode_stage_seconds_count", {"stage": "vlad"}) or 0


async def test_a_frame_is_decoded_and_encoded(queue: EncoderQueue) -> None:
    encoded = await queue.encode(IDENTITY, jpeg(1), deadline())
    assert encoded.pixels.shape == (240, 320, 3) and len(encoded.encoding.regions) > 0
    assert set(encoded.milliseconds) == {"wait", "decode", "forward", "regions", "vlad"}
    assert frames_encoded(queue) == 1


async def test_the_event_loop_goes_on(queue: EncoderQueue, busy: threading.Event) -> None:
    waiting = asyncio.ensure_future(queue.encode(IDENTITY, jpeg(1), deadline()))
    for _ in range(100):
        await asyncio.sleep(0)
    assert not waiting.done()
    busy.set()
    assert (await waiting).milliseconds["wait"] > 0


async def test_a_full_queue_refuses(queue: EncoderQueue) -> None:
    with queue.place(), queue.place():
        with pytest.raises(QueueFull):
            queue.check_room()
        with pytest.raises(QueueFull), queue.place():
            pass
    queue.check_room()
    assert queue._metrics.registry.get_sample_value("placerec_queue_length") == 0


def as_caller(caller: str, work: Coroutine[Any, Any, Made]) -> asyncio.Task[Made]:
    """Work that a caller has asked for."""
    context = copy_context()
    context.run(CALLER.set, caller)
    return asyncio.get_running_loop().create_task(work, context=context)


async def test_the_caller_with_most_places_gives_way_to_another(queue: EncoderQueue, busy: threading.Event) -> None:
    async def ask(seed: int, frames: int = 1) -> Encoded:
        with queue.place(frames):
            return await queue.encode(IDENTITY, jpeg(seed), deadline())

    greedy = [as_caller("greedy", ask(seed)) for seed in (1, 2, 3)]
    with pytest.raises(QueueFull):
        await greedy[2]
    robot = as_caller("robot", ask(4))
    with pytest.raises(QueueFull):
        await greedy[1]
    assert queue.waiting == 2
    for caller in ("robot", "greedy"):
        with pytest.raises(QueueFull):  # both have one now
            await as_caller(caller, ask(5))
    busy.set()
    assert len((await robot).encoding.regions) and len((await greedy[0]).encoding.regions)
    assert queue.waiting == 0


async def test_a_batch_gives_way_as_a_whole_unless_it_is_being_encoded(
    queue: EncoderQueue, busy: threading.Event
) -> None:
    async def batch() -> int:
        with queue.place(3):
            return len([one async for some in queue.encode_many(IDENTITY, [jpeg(1)] * 3, deadline()) for one in some])

    async def ask() -> Encoded:
        with queue.place(3):
            return await queue.encode(IDENTITY, jpeg(2), deadline())

    first = as_caller("greedy", batch())
    await asyncio.sleep(0)
    while not queue.waiting or not len(queue.encoders._waiting):
        await asyncio.sleep(0.001)
    with pytest.raises(QueueFull):  # bulk requests have one place of two, and nobody has more than one
        await as_caller("robot", ask())
    queue._bulk_room.capacity = 2
    second = as_caller("greedy", batch())
    while queue.waiting < 2:
        await asyncio.sleep(0.001)
    robot = as_caller("robot", ask())
    with pytest.raises(QueueFull):
        await second
    busy.set()
    assert await first == 3 and len((await robot).encoding.regions)


async def test_a_late_frame_is_dropped_before_it_is_encoded(queue: EncoderQueue, busy: threading.Event) -> None:
    async with asyncio.timeout(30):  # told at the deadline, not when the encoder is free
        with pytest.raises(DeadlineExceeded):
            await queue.encode(IDENTITY, jpeg(1), deadline(0.2))
    with pytest.raises(DeadlineExceeded):
        await queue.encode(IDENTITY, jpeg(1), deadline(-1))
    busy.set()
    await queue.encode(IDENTITY, jpeg(2), deadline())
    assert frames_encoded(queue) == 1


async def test_the_frame_of_a_client_that_hangs_up_is_dropped(queue: EncoderQueue, busy: threading.Event) -> None:
    async def leaves() -> None:
        await asyncio.sleep(0.05)

    with pytest.raises(ClientGone):
        await queue.encode(IDENTITY, jpeg(1), RequestDeadline(time.monotonic() + 30, leaves))
    busy.set()
    await queue.encode(IDENTITY, jpeg(2), deadline())
    assert frames_encoded(queue) == 1


async def test_the_frame_of_a_cancelled_request_is_dropped(queue: EncoderQueue, busy: threading.Event) -> None:
    waiting = asyncio.ensure_future(queue.encode(IDENTITY, jpeg(1), deadline()))
    await asyncio.sleep(0.05)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    busy.set()
    await queue.encode(IDENTITY, jpeg(2), deadline())
    assert frames_encoded(queue) == 1


async def test_a_poisoned_frame_fails_alone(queue: EncoderQueue) -> None:
    frames = [jpeg(1), b"poison", jpeg(2)]
    results = await asyncio.gather(
        *(queue.encode(IDENTITY, data, deadline()) for data in frames), return_exceptions=True
    )
    assert isinstance(results[1], NotAnImage)
    assert not isinstance(results[0], BaseException) and not isinstance(results[2], BaseException)


async def test_an_encoder_that_is_not_there(queue: EncoderQueue) -> None:
    with pytest.raises(EncoderNotInstalled):
        await queue.load("absent")
    with pytest.raises(EncoderNotInstalled):
        await queue.encode("absent", jpeg(1), deadline())


async def test_a_deadline_holds_while_the_encoder_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    free = threading.Event()
    get = EncoderCatalogue.get

    def slow(self: EncoderCatalogue, identity: str) -> Encoder:
        free.wait(60)
        return get(self, identity)

    monkeypatch.setattr(EncoderCatalogue, "get", slow)
    queue = EncoderQueue(EncoderCatalogue(), Limits(), queue_length=2, threads=0, metrics=Metrics())
    try:
        with pytest.raises(DeadlineExceeded):
            await queue.encode(IDENTITY, jpeg(1), deadline(0.1))
        with pytest.raises(DeadlineExceeded):
            await anext(queue.encode_many(IDENTITY, [jpeg(1)], deadline(0.1)))
        free.set()
        assert (await queue.encode(IDENTITY, jpeg(1), deadline())).encoder is await queue.load(IDENTITY)
    finally:
        free.set()
        queue.close()


HEADERS = {"Content-Type": "image/jpeg"}


def test_an_overloaded_server_says_when_to_come_back(tight_server: Server) -> None:
    frame = encoded(scene(1), quality=60)
    with ThreadPoolExecutor(16) as pool:
        answers = list(
            pool.map(lambda _: tight_server.client.post("/v1/encode", content=frame, headers=HEADERS), range(64))
        )
    statuses = {answer.status_code for answer in answers}
    assert statuses == {200, 503}
    for answer in answers:
        if answer.status_code == 503:
            assert_problem(answer, 503, "queue-full")
            assert 1 <= int(answer.headers["retry-after"]) <= 3
    assert tight_server.client.post("/v1/encode", content=frame, headers=HEADERS).status_code == 200
    assert 'placerec_problems_total{type="queue-full"}' in tight_server.client.get("/metrics").text


@pytest.mark.thorough
def test_a_busy_server_is_alive_and_keeps_deadlines(server: Server) -> None:
    large, enough = encoded(scene(1, 3000, 3000)), threading.Event()
    durations: list[float] = []

    def encode_large_frames() -> None:
        while not enough.is_set():
            start = time.monotonic()
            assert server.client.post("/v1/encode", content=large, headers=HEADERS).status_code == 200
            durations.append(time.monotonic() - start)

    alive: list[float] = []
    refused: list[httpx.Response] = []
    with ThreadPoolExecutor(4) as pool:
        callers = [pool.submit(encode_large_frames) for _ in range(4)]
        try:
            # Until both were seen often enough: a processor that is fast or busy takes more turns to the same result.
            began = time.monotonic()
            while (len(refused) < 3 or len(durations) < 8) and time.monotonic() - began < 60:
                start = time.monotonic()
                assert server.client.get("/livez").status_code == 200
                alive.append(time.monotonic() - start)
                hurried = {**HEADERS, "X-Request-Timeout": "0.001"}
                answer = server.client.post("/v1/encode", content=jpeg(1), headers=hurried)
                if answer.status_code == 503:
                    refused.append(answer)
        finally:
            enough.set()
        for caller in callers:
            caller.result()
    assert len(refused) >= 3, "a frame that would have waited for a large one was dropped"
    assert median(alive) < median(durations), "being asked for a sign of life does not wait for the encoder"
    for answer in refused:
        assert_problem(answer, 503, "deadline-exceeded")
        assert 1 <= int(answer.headers["retry-after"]) <= 3


@pytest.mark.parametrize("value", ["0", "-1", "soon", "nan", "inf", "1e9"])
def test_a_bad_deadline(server: Server, value: str) -> None:
    response = server.client.post("/v1/encode", content=jpeg(1), headers={**HEADERS, "X-Request-Timeout": value})
    assert_problem(response, 422, "invalid-request")


def test_requests_of_many_frames_have_half_of_the_queue() -> None:
    queue = EncoderQueue(EncoderCatalogue(), Limits(), 8, 0, Metrics())
    try:
        with ExitStack() as places:
            for _ in range(4):
                places.enter_context(queue.place(2))
            with pytest.raises(QueueFull), queue.place(2):
                pass
            for _ in range(4):
                places.enter_context(queue.place(1))
            with pytest.raises(QueueFull), queue.place(1):
                pass
        with queue.place(2):
            assert queue.waiting == 1
    finally:
        queue.close()
