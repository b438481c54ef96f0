"""Frames that wait at the same time share the cores, but neither errors, nor delays, nor values."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from core.errors import InvalidImage, NotAnImage, TruncatedImage
from core.frames.images import Limits, decode
from core.frames.masks import Mask
from core.frames.preprocessing import Pixels
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.threads import allowed_threads, cores
from service.engine import encoder_threads
from service.engine.encoder_threads import AHEAD, MOST_PIXELS, EncoderThreads
from service.engine.encoders import BULK_SHARE, Encoded, QueuedFrame, WaitingFrames
from service.engine.queue import EncoderQueue, Outcomes, RequestDeadline
from service.errors.faults import ClientGone, DeadlineExceeded
from service.telemetry.metrics import Metrics
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.engine.busy import keep_busy
from tests.service.scenes import encoded, jpeg, scene
from tests.service.server import Server
from tests.service.wire import eventually

UPPER_HALF = Mask(polygons=(((0, 0), (1, 0), (1, 0.5), (0, 0.5)),))


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory: pytest.TempPathFactory) -> EncoderCatalogue:
    """The packaged encoders and one with other values."""
    folder = tmp_path_factory.mktemp("models")
    install_coarse_encoder(folder)
    return EncoderCatalogue(folder)


@pytest.fixture(scope="module")
def default(catalogue: EncoderCatalogue) -> Encoder:
    return catalogue.get(catalogue.resolve(DEFAULT_ENCODER))


class Watched:
    """The encoder's threads; the order in which they take frames is noted, and they can be held up."""

    def __init__(self, catalogue: EncoderCatalogue) -> None:
        self._encoders = {name: catalogue.get(name) for name in (DEFAULT_ENCODER, COARSE)}
        self.threads = EncoderThreads(Limits())
        self.taken: list[QueuedFrame] = []
        """The frames in the order in which threads took them."""
        take = self.threads._next

        def noted() -> tuple[QueuedFrame, bool] | None:
            with self.threads._changed:
                if (found := take()) is not None:
                    self.taken.append(found[0])
                return found

        self.threads._next = noted  # type: ignore[method-assign]
        self.hold()()  # they wait in the method of before

    def hold(self) -> Callable[[], None]:
        """Keep the threads busy until what is returned is called."""
        held, free = keep_busy(self.threads, self._encoders[DEFAULT_ENCODER])
        self.taken = [frame for frame in self.taken if frame not in held]
        return free.set

    def wait_until_idle(self) -> None:
        """Wait until the thread that has answered is free again."""
        assert eventually(lambda: not self.threads._at_work, every=0.001)

    def put_together(self, frames: Sequence[QueuedFrame]) -> None:
        """Let the frames wait until all of them do."""
        go = self.hold()
        self.threads.put(frames)
        go()

    def frame(self, seed: int, name: str = DEFAULT_ENCODER, **more: Any) -> QueuedFrame:
        given: dict[str, Any] = {"mask": None, "deadline": time.monotonic() + 60, **more}
        return QueuedFrame(self._encoders[name], given.pop("data", None) or jpeg(seed), **given)


@pytest.fixture
def watched(catalogue: EncoderCatalogue) -> Iterator[Watched]:
    made = Watched(catalogue)
    yield made
    made.threads.close()


def cosine(a: Encoding, b: Encoding) -> float:
    one, other = (encoding.descriptor.astype(np.float64) for encoding in (a, b))
    return float(one @ other / (np.linalg.norm(one) * np.linalg.norm(other)))


def answers(frames: Sequence[QueuedFrame]) -> list[Encoded]:
    return [frame.result.result(60) for frame in frames]


def test_frames_in_company_have_the_encodings_of_frames_alone(watched: Watched, default: Encoder) -> None:
    frames = [watched.frame(seed, mask=UPPER_HALF if seed == 2 else None) for seed in range(5)]
    watched.put_together(frames)
    for seed, (frame, found) in enumerate(zip(frames, answers(frames), strict=True)):
        alone = default.encode(decode(frame.data), frame.mask)
        assert cosine(found.encoding, alone) > 0.9999, seed
        assert len(found.encoding.regions) == len(alone.regions)
        assert np.abs(found.encoding.local.astype(int) - alone.local).max(initial=0) <= 1
        assert np.array_equal(found.pixels, decode(frame.data))
    assert cosine(frames[2].result.result().encoding, default.encode(scene(2))) < 0.99, "the mask counted"


def test_a_frame_alone_has_all_cores_and_several_frames_have_one_each(watched: Watched) -> None:
    used: list[int] = []

    def note(_: Encoded) -> None:
        used.append(allowed_threads())

    for seed in range(3):
        watched.wait_until_idle()
        watched.threads.put([alone := watched.frame(seed, after_encoding=note)])
        answers([alone])
    assert used == [allowed_threads()] * 3
    watched.wait_until_idle()
    together = [watched.frame(seed, after_encoding=note) for seed in range(8)]
    watched.put_together(together)
    answers(together)
    assert set(used[3:-1]) == {1}, "the last one may find nothing else to do"


def test_many_frames_are_taken_in_order(watched: Watched) -> None:
    frames = [watched.frame(seed % 4) for seed in range(8 * cores() + 3)]
    watched.put_together(frames)
    answers(frames)
    assert watched.taken == frames


@pytest.mark.parametrize("poison", [b"poison", jpeg(1)[:2000]])
def test_a_poisoned_image_fails_alone(watched: Watched, poison: bytes) -> None:
    frames = [watched.frame(0), watched.frame(1, data=poison), watched.frame(2)]
    watched.put_together(frames)
    assert isinstance(frames[1].result.exception(60), (NotAnImage, TruncatedImage))
    assert len(answers([frames[0], frames[2]])) == 2


def test_a_frame_that_breaks_the_encoder_fails_alone(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    encode = Encoder.encode
    cursed = decode(jpeg(1))

    def breaks(self: Encoder, pixels: Pixels, mask: Mask | None = None) -> Encoding:
        if np.array_equal(pixels, cursed):
            raise ArithmeticError("this one cannot be encoded")
        return encode(self, pixels, mask)

    monkeypatch.setattr(Encoder, "encode", breaks)
    frames = [watched.frame(seed) for seed in range(3)]
    watched.put_together(frames)
    assert isinstance(frames[1].result.exception(60), ArithmeticError)
    assert len(answers([frames[0], frames[2]])) == 2


def test_frames_of_several_encoders_wait_together(watched: Watched) -> None:
    names = [DEFAULT_ENCODER, COARSE, DEFAULT_ENCODER, COARSE, COARSE]
    frames = [watched.frame(seed, name) for seed, name in enumerate(names)]
    watched.put_together(frames)
    found = answers(frames)
    assert [one.encoder.name for one in found] == names
    for seed, one in enumerate(found):
        assert cosine(one.encoding, one.encoder.encode(scene_of(seed))) > 0.9999


def scene_of(seed: int) -> Pixels:
    return decode(jpeg(seed))


def test_late_and_cancelled_frames_are_not_encoded(watched: Watched) -> None:
    late, given_up, there = watched.frame(0, deadline=time.monotonic() - 1), watched.frame(1), watched.frame(2)
    go = watched.hold()
    watched.threads.put([late, given_up, there])
    assert given_up.result.cancel()
    go()
    there.result.result(60)
    assert isinstance(late.result.exception(60), DeadlineExceeded)
    with pytest.raises(CancelledError):
        given_up.result.result(60)
    assert watched.taken == [late, there]


def test_robots_come_first_and_bulk_keeps_a_share(watched: Watched) -> None:
    bulk = [watched.frame(0, COARSE, bulk=True) for _ in range(8)]
    robots = [watched.frame(1) for _ in range(12)]
    watched.put_together([*bulk, *robots])
    answers([*bulk, *robots])
    kinds = [frame.bulk for frame in watched.taken]
    one_turn = [False] * (BULK_SHARE - 1) + [True]
    assert kinds == one_turn * 4 + [True] * 4
    assert [frame for frame in watched.taken if frame.bulk] == bulk


@pytest.mark.thorough
def test_the_pixels_decoded_at_one_time_are_bounded(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    if allowed_threads() == 1:
        pytest.skip("one thread never has two frames")
    lock, at_once, most = threading.Lock(), 0, 0
    encode = watched.threads._encode

    def counted(frame: QueuedFrame) -> None:
        nonlocal at_once, most
        with lock:
            at_once += 1
            most = max(most, at_once)
        encode(frame)
        with lock:
            at_once -= 1

    frames = [watched.frame(seed) for seed in range(7)]
    frames.append(watched.frame(9, data=encoded(scene(9, 1280, 960))))  # by itself over the limit
    monkeypatch.setattr(encoder_threads, "FEW_PIXELS", 0)
    go = watched.hold()
    monkeypatch.setattr(encoder_threads, "MOST_PIXELS", 2 * 320 * 240 - 1)
    monkeypatch.setattr(watched.threads, "_encode", counted)
    watched.threads.put(frames)
    go()
    answers(frames)
    assert most == 1
    monkeypatch.setattr(encoder_threads, "MOST_PIXELS", MOST_PIXELS)
    watched.put_together(more := [watched.frame(seed) for seed in range(7)])
    answers(more)
    assert most > 1


def test_a_header_that_promises_too_many_pixels_holds_nobody_up(watched: Watched) -> None:
    lies = bytearray(jpeg(0))
    size = lies.index(b"\xff\xc0") + 5
    lies[size : size + 4] = b"\xff" * 4
    frame = watched.frame(0, data=bytes(lies))
    assert frame.pixels == 65535 * 65535
    watched.threads.put([frame])
    assert isinstance(frame.result.exception(timeout=60), InvalidImage)
    assert frame.pixels == 0


def test_waiting_frames_are_cancelled_at_the_end(catalogue: EncoderCatalogue) -> None:
    watched = Watched(catalogue)
    go = watched.hold()
    watched.threads.put([frame := watched.frame(0)])
    closing = threading.Thread(target=watched.threads.close)
    closing.start()
    assert eventually(frame.result.cancelled)
    assert closing.is_alive(), "it waits for the frames that have begun"
    go()
    closing.join(60)
    assert not closing.is_alive()
    watched.threads.put([after := watched.frame(0)])
    assert after.result.cancelled()


# Many frames of one request


async def stays() -> None:
    await asyncio.Event().wait()


@pytest.fixture
def queue(catalogue: EncoderCatalogue) -> Iterator[EncoderQueue]:
    made = EncoderQueue(catalogue, Limits(), queue_length=2, threads=0, metrics=Metrics())
    yield made
    made.close()


def waiting(queue: EncoderQueue) -> WaitingFrames:
    return queue.encoders._waiting


async def collected(queue: EncoderQueue, frames: Sequence[bytes], deadline: RequestDeadline) -> Outcomes:
    identity = EncoderCatalogue().resolve(DEFAULT_ENCODER)
    return [one async for some in queue.encode_many(identity, frames, deadline) for one in some]


def test_one_callers_frames_delay_another_by_no_more_than_one(watched: Watched) -> None:
    go = watched.hold()
    greedy = [watched.frame(seed, caller="greedy") for seed in range(6)]
    watched.threads.put(greedy)
    robot = watched.frame(7, caller="robot")
    watched.threads.put([robot])
    go()
    answers([*greedy, robot])
    assert watched.taken.index(robot) <= 1
    assert [frame for frame in watched.taken if frame is not robot] == greedy, "those of one caller stay in order"


@pytest.mark.thorough
def test_large_frames_are_more_turns_than_small_ones(watched: Watched) -> None:
    """What frames are expected to take counts as soon as they are taken, so this is the same at any speed."""
    frames = WaitingFrames()
    large = [watched.frame(0, data=encoded(scene(1, 4000, 3000)), caller="greedy") for _ in range(3)]
    small = [watched.frame(seed, caller="robot") for seed in range(12)]
    for frame in [*large, *small]:
        frames.add(frame)
    order = []
    while (following := frames.first()) is not None:
        frames.remove_first()
        frames.count_turn(following)
        order.append(following)
    first, second = order.index(large[0]), order.index(large[1])
    assert first == 0 and 6 <= second <= 8, "140 ms are expected for twelve million pixels, and 21 for a small frame"


@pytest.mark.thorough
@pytest.mark.anyio
async def test_many_frames_of_one_request(queue: EncoderQueue, default: Encoder) -> None:
    frames = [jpeg(index % 6) for index in range(AHEAD + 10)]
    frames[4] = b"poison"
    found = await collected(queue, frames, RequestDeadline(time.monotonic() + 60, stays))
    assert sorted(index for index, _ in found) == list(range(len(frames)))
    for index, outcome in found:
        if index == 4:
            assert isinstance(outcome, NotAnImage)
        else:
            assert not isinstance(outcome, Exception)
            assert cosine(outcome.encoding, default.encode(scene_of(index % 6))) > 0.9999
    assert await collected(queue, [], RequestDeadline(time.monotonic() + 60, stays)) == []


@pytest.mark.anyio
@pytest.mark.parametrize("fault", [DeadlineExceeded, ClientGone])
async def test_waiting_frames_of_an_aborted_request_are_cancelled(queue: EncoderQueue, fault: type[Exception]) -> None:
    async def leaves() -> None:
        await asyncio.sleep(0.2)

    encoder = await queue.load(EncoderCatalogue().resolve(DEFAULT_ENCODER))
    _, free = keep_busy(queue.encoders, encoder)
    deadline = RequestDeadline(time.monotonic() + (0.2 if fault is DeadlineExceeded else 60), leaves)
    if fault is DeadlineExceeded:
        deadline = RequestDeadline(deadline.at, stays)
    with pytest.raises(fault):
        await collected(queue, [jpeg(0)] * (AHEAD + 5), deadline)
    left = waiting(queue)
    assert not left._robots and left._bulk and all(frame.result.cancelled() for frame in left._bulk.clear())
    free.set()
    await queue.encode(encoder.identity, jpeg(1), RequestDeadline(time.monotonic() + 60, stays))


@pytest.mark.thorough
@pytest.mark.anyio
async def test_a_frame_that_is_too_late_ends_its_request(queue: EncoderQueue) -> None:
    """The deadline passes while the caller is busy with earlier frames; the last ones find it over in their turn."""
    await queue.load(identity := EncoderCatalogue().resolve(DEFAULT_ENCODER))
    at = time.monotonic() + 1
    with pytest.raises(DeadlineExceeded):
        async for _ in queue.encode_many(identity, [jpeg(0)] * (AHEAD + 2), RequestDeadline(at, stays)):
            await asyncio.sleep(max(0.0, at - time.monotonic()))
            while len(waiting(queue)):
                await asyncio.sleep(0.01)


@pytest.mark.anyio
@pytest.mark.parametrize(("seconds", "fault"), [(60, ClientGone), (0.1, DeadlineExceeded)])
async def test_nobody_waits_for_an_encoder_in_vain(
    queue: EncoderQueue, monkeypatch: pytest.MonkeyPatch, seconds: float, fault: type[Exception]
) -> None:
    free = threading.Event()
    load = queue._load

    def slow(identity: str) -> Encoder:
        free.wait(60)
        return load(identity)

    async def leaves() -> None:
        if fault is not ClientGone:
            await stays()

    monkeypatch.setattr(queue, "_load", slow)
    identity = EncoderCatalogue().resolve(DEFAULT_ENCODER)
    with pytest.raises(fault):
        await queue.encode(identity, jpeg(0), RequestDeadline(time.monotonic() + seconds, leaves))
    free.set()
    await queue.encode(identity, jpeg(0), RequestDeadline(time.monotonic() + 60, stays))


# Over HTTP


@pytest.mark.thorough
def test_robots_together_get_the_answers_of_robots_alone(server: Server, traverse: str) -> None:
    frames = [jpeg(seed) for seed in range(8)]
    alone = [server.query(traverse, data) for data in frames]
    with ThreadPoolExecutor(16) as robots:
        together = list(robots.map(lambda index: server.query(traverse, frames[index % 8]), range(48)))
    for index, answer in enumerate(together):
        expected = alone[index % 8]
        assert answer["verdict"] == expected["verdict"]
        assert [match["place"]["id"] for match in answer["matches"]] == [
            match["place"]["id"] for match in expected["matches"]
        ]
        assert answer["score"] == pytest.approx(expected["score"], abs=2e-3)


def test_a_batch_over_http_has_an_answer_or_a_problem_for_each_frame(server: Server, traverse: str) -> None:
    files = [(f"f{index}", ("f.jpg", jpeg(index % 8), "image/jpeg")) for index in range(16)]
    files[3] = ("f3", ("f.jpg", b"\xff\xd8\xff poison", "image/jpeg"))
    response = server.client.post(f"/v1/maps/{traverse}/query:batch", files=files)
    items = response.json()["items"]
    assert [item["file"] for item in items] == [f"f{index}" for index in range(16)]
    assert [item["status"] for item in items] == [200] * 3 + [422] + [200] * 12
    for index, item in enumerate(items):
        if index != 3:
            assert item["answer"]["matches"][0]["place"]["id"] == f"p{index % 8}"


@pytest.mark.thorough
def test_bulk_does_not_keep_a_robot_waiting(server: Server, traverse: str, map_id: str, tmp_path: Path) -> None:
    entries = [{"id": f"b{index}", "file": f"b{index}"} for index in range(40)]
    files = [(f"b{index}", ("b.jpg", jpeg(index % 50, 640, 480), "image/jpeg")) for index in range(40)]

    def enrol() -> tuple[httpx.Response, float]:
        began = time.monotonic()
        form = {"places": (None, json.dumps(entries), "application/json")}
        answer = server.client.post(f"/v1/maps/{map_id}/places", files=[*form.items(), *files])
        return answer, time.monotonic() - began

    with ThreadPoolExecutor(1) as bulk:
        job = bulk.submit(enrol)
        waits = []
        while not job.done():
            waits.append(server.query(traverse, jpeg(2))["milliseconds"].get("wait", 0.0))
        response, seconds = job.result()
    assert response.status_code == 200 and all(item["status"] == 201 for item in response.json()["items"])
    assert len(waits) > 3
    assert float(np.median(waits)) < 1e3 * seconds / 4, "a robot's frame did not wait for the whole request"
