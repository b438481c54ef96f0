"""Frames that wait at the same time share a forward pass, but neither errors, nor delays, nor values."""

from __future__ import annotations

import asyncio
import json
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from core.errors import NotAnImage, TruncatedImage, UnknownEncoder
from core.frames.images import Limits, decode
from core.frames.masks import Mask
from core.frames.preprocessing import Pixels
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.threads import cores
from service.engine import microbatches
from service.engine.microbatches import MOST_BULK, MOST_FRAMES, Encoded, MicroBatches, QueuedFrame
from service.engine.queue import AHEAD, EncoderQueue, Outcomes, RequestDeadline
from service.errors.faults import ClientGone, DeadlineExceeded
from service.telemetry.metrics import Metrics
from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.scenes import encoded, jpeg, scene
from tests.service.server import Server

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
    """Batches of real encoders; what shared a forward pass is noted, and the thread can be held up."""

    def __init__(self, catalogue: EncoderCatalogue) -> None:
        self.loaded: dict[str, Encoder] = {}
        self.sizes: list[int] = []
        self.catalogue = catalogue
        self.batches = MicroBatches(self.load, Limits(), self.sizes.append)
        self.taken: list[list[QueuedFrame]] = []
        """The batches in the order in which threads took them."""
        take = self.batches._take

        def noted(share: int) -> list[QueuedFrame]:
            if found := take(share):
                self.taken.append(found)
            return found

        self.batches._take = noted  # type: ignore[method-assign]

    def load(self, identity: str) -> Encoder:
        return self.loaded.setdefault(identity, self.catalogue.get(identity))

    def hold(self) -> Callable[[], None]:
        """Keep the thread busy until what is returned is called."""
        begun, free = threading.Event(), threading.Event()

        def wait() -> None:
            begun.set()
            free.wait(30)

        self.batches.call(wait)
        assert begun.wait(30)
        return free.set

    def put_together(self, frames: Sequence[QueuedFrame]) -> None:
        """Let the frames wait until all of them do."""
        go = self.hold()
        self.batches.put(frames)
        go()

    def frame(self, seed: int, name: str = DEFAULT_ENCODER, **more: Any) -> QueuedFrame:
        given: dict[str, Any] = {"mask": None, "deadline": time.monotonic() + 60, **more}
        return QueuedFrame(self.catalogue.resolve(name), given.pop("data", None) or jpeg(seed), **given)


@pytest.fixture
def watched(catalogue: EncoderCatalogue) -> Iterator[Watched]:
    made = Watched(catalogue)
    yield made
    made.batches.close()


def cosine(a: Encoding, b: Encoding) -> float:
    one, other = (encoding.descriptor.astype(np.float64) for encoding in (a, b))
    return float(one @ other / (np.linalg.norm(one) * np.linalg.norm(other)))


def noting(order: list[Any], what: object) -> Callable[[Future[Encoded]], None]:
    """Notes when a frame is settled."""
    return lambda _: order.append(what)


def answers(frames: Sequence[QueuedFrame]) -> list[Encoded]:
    return [frame.result.result(60) for frame in frames]


def test_frames_that_share_a_pass_have_the_encodings_of_frames_alone(watched: Watched, default: Encoder) -> None:
    frames = [watched.frame(seed, mask=UPPER_HALF if seed == 2 else None) for seed in range(5)]
    watched.put_together(frames)
    for seed, (frame, found) in enumerate(zip(frames, answers(frames), strict=True)):
        alone = default.encode(decode(frame.data), frame.mask)
        assert cosine(found.encoding, alone) > 0.9999, seed
        assert len(found.encoding.regions) == len(alone.regions)
        assert np.abs(found.encoding.local.astype(int) - alone.local).max(initial=0) <= 1
        assert np.array_equal(found.pixels, decode(frame.data))
    assert sum(watched.sizes) == 5 and len(watched.sizes) < 5
    assert cosine(frames[2].result.result().encoding, default.encode(scene(2))) < 0.99, "the mask counted"


def test_a_single_frame_does_not_wait_for_others(watched: Watched) -> None:
    for seed in range(3):
        frame = watched.frame(seed)
        watched.batches.put([frame])
        frame.result.result(60)
    assert watched.sizes == [1, 1, 1]


def test_many_frames_are_several_batches_in_order(watched: Watched) -> None:
    count = 2 * cores() * MOST_FRAMES + 3
    frames = [watched.frame(seed % 4) for seed in range(count)]
    watched.put_together(frames)
    answers(frames)
    assert [frame for batch in watched.taken for frame in batch] == frames
    assert sum(watched.sizes) == count and max(watched.sizes) == MOST_FRAMES


@pytest.mark.parametrize("poison", [b"poison", jpeg(1)[:2000]])
def test_a_poisoned_image_fails_alone(watched: Watched, poison: bytes) -> None:
    frames = [watched.frame(0), watched.frame(1, data=poison), watched.frame(2)]
    watched.put_together(frames)
    assert isinstance(frames[1].result.exception(60), (NotAnImage, TruncatedImage))
    assert len(answers([frames[0], frames[2]])) == 2
    assert sum(watched.sizes) == 2


def test_a_frame_that_breaks_the_encoder_fails_alone(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    encode_batch = Encoder.encode_batch
    cursed = decode(jpeg(1))

    def breaks(self: Encoder, frames: Sequence[Pixels], masks: Sequence[Mask | None] | None = None) -> list[Encoding]:
        if any(np.array_equal(frame, cursed) for frame in frames):
            raise ArithmeticError("this one cannot be encoded")
        return encode_batch(self, frames, masks)

    monkeypatch.setattr(Encoder, "encode_batch", breaks)
    frames = [watched.frame(seed) for seed in range(3)]
    watched.put_together(frames)
    assert isinstance(frames[1].result.exception(60), ArithmeticError)
    assert len(answers([frames[0], frames[2]])) == 2


def test_encoders_are_batched_apart(watched: Watched, catalogue: EncoderCatalogue) -> None:
    names = [DEFAULT_ENCODER, COARSE, DEFAULT_ENCODER, COARSE, COARSE]
    frames = [watched.frame(seed, name) for seed, name in enumerate(names)]
    watched.put_together(frames)
    found = answers(frames)
    assert [one.encoder.name for one in found] == names
    assert sum(watched.sizes) == 5 and len(watched.sizes) < 5
    for seed, one in enumerate(found):
        assert cosine(one.encoding, one.encoder.encode(scene_of(seed))) > 0.9999


def scene_of(seed: int) -> Pixels:
    return decode(jpeg(seed))


def test_an_encoder_that_is_not_there_fails_its_own_frames(watched: Watched) -> None:
    absent = QueuedFrame("absent", jpeg(0), None, time.monotonic() + 60)
    there = watched.frame(1)
    watched.put_together([absent, there])
    assert isinstance(absent.result.exception(60), UnknownEncoder)
    assert there.result.result(60).encoder.name == DEFAULT_ENCODER


def test_late_and_cancelled_frames_are_not_encoded(watched: Watched) -> None:
    late, given_up, there = watched.frame(0, deadline=time.monotonic() - 1), watched.frame(1), watched.frame(2)
    go = watched.hold()
    watched.batches.put([late, given_up, there])
    assert given_up.result.cancel()
    go()
    there.result.result(60)
    assert isinstance(late.result.exception(60), DeadlineExceeded)
    with pytest.raises(CancelledError):
        given_up.result.result(60)
    assert watched.sizes == [1]


def test_robots_come_first_and_bulk_keeps_a_share(watched: Watched) -> None:
    bulk = [watched.frame(0, bulk=True) for _ in range(cores() * (MOST_BULK + 6))]
    robots = [watched.frame(1) for _ in range(cores() * MOST_FRAMES)]
    watched.batches.put(first := [watched.frame(0)])
    answers(first)  # its encoder is loaded
    go = watched.hold()
    watched.batches.put(bulk)
    watched.batches.put(robots)
    go()
    answers([*bulk, *robots])
    kept = MOST_FRAMES // microbatches.BULK_SHARE
    kinds = [[frame.bulk for frame in batch] for batch in watched.taken[1:]]
    most = MOST_FRAMES - kept
    with_robots = -(-len(robots) // most)
    assert kinds[: len(robots) // most] == [[False] * most + [True] * kept] * (len(robots) // most)
    assert all(False in batch for batch in kinds[:with_robots]), "the robots that are left come before more bulk"
    assert all(all(batch) and len(batch) <= MOST_BULK for batch in kinds[with_robots:])


@pytest.mark.parametrize(("seconds", "from_robot"), [(0.0, True), (3600.0, True), (3600.0, False)])
def test_batches_of_bulk_are_small_while_robots_send_frames(
    watched: Watched, seconds: float, from_robot: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(microbatches, "QUIET_SECONDS", seconds)
    watched.batches.put(first := [watched.frame(0, from_robot=from_robot)])
    answers(first)
    frames = [watched.frame(0, bulk=True) for _ in range(cores() * MOST_FRAMES)]
    watched.put_together(frames)
    answers(frames)
    most = MOST_BULK if seconds and from_robot else MOST_FRAMES
    assert max(watched.sizes[1:]) == most and len(watched.sizes[1:]) <= len(frames) // most + cores()


def test_the_pixels_decoded_at_one_time_are_bounded(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(microbatches, "MOST_PIXELS", 3 * 320 * 240)
    frames = [watched.frame(seed) for seed in range(7)]
    frames.append(watched.frame(9, data=encoded(scene(9, 1280, 960))))  # by itself over the limit
    watched.put_together(frames)
    answers(frames)
    assert watched.sizes == [3, 3, 1, 1]


def test_waiting_frames_are_cancelled_at_the_end(catalogue: EncoderCatalogue) -> None:
    watched = Watched(catalogue)
    go = watched.hold()
    frame, task = watched.frame(0), watched.batches.call(lambda: None)
    watched.batches.put([frame])
    threading.Timer(0.2, go).start()
    watched.batches.close()
    assert frame.result.cancelled() and task.cancelled()
    after: Future[None] = watched.batches.call(lambda: None)
    assert after.cancelled()


# Many frames of one request


async def stays() -> None:
    await asyncio.Event().wait()


@pytest.fixture
def queue(catalogue: EncoderCatalogue) -> Iterator[EncoderQueue]:
    made = EncoderQueue(catalogue, Limits(), queue_length=2, threads=0, metrics=Metrics())
    yield made
    made.close()


async def collected(queue: EncoderQueue, frames: Sequence[bytes], deadline: RequestDeadline) -> Outcomes:
    identity = EncoderCatalogue().resolve(DEFAULT_ENCODER)
    return [one async for some in queue.encode_many(identity, frames, deadline) for one in some]


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

    await queue.load(EncoderCatalogue().resolve(DEFAULT_ENCODER))
    free = threading.Event()
    queue._batches.call(lambda: free.wait(30))
    deadline = RequestDeadline(time.monotonic() + (0.2 if fault is DeadlineExceeded else 60), leaves)
    if fault is DeadlineExceeded:
        deadline = RequestDeadline(deadline.at, stays)
    with pytest.raises(fault):
        await collected(queue, [jpeg(0)] * (AHEAD + 5), deadline)
    free.set()
    await queue.encode(
        EncoderCatalogue().resolve(DEFAULT_ENCODER), jpeg(1), RequestDeadline(time.monotonic() + 60, stays)
    )
    count = queue._metrics.registry.get_sample_value("placerec_encoded_together_sum")
    assert count == 1, "nothing of the request was encoded"


# Over HTTP


def sample(client: httpx.Client, name: str) -> float:
    (line,) = re.findall(rf"^{re.escape(name)} (.+)$", client.get("/metrics").text, re.MULTILINE)
    return float(line)


def test_robots_share_forward_passes(server: Server, traverse: str) -> None:
    frames = [jpeg(seed) for seed in range(8)]
    alone = [server.query(traverse, data) for data in frames]
    passes = sample(server.client, "placerec_encoded_together_count")
    with ThreadPoolExecutor(16) as robots:
        together = list(robots.map(lambda index: server.query(traverse, frames[index % 8]), range(96)))
    assert sample(server.client, "placerec_encoded_together_count") - passes < 96
    for index, answer in enumerate(together):
        expected = alone[index % 8]
        assert answer["verdict"] == expected["verdict"]
        assert [match["place"]["id"] for match in answer["matches"]] == [
            match["place"]["id"] for match in expected["matches"]
        ]
        assert answer["score"] == pytest.approx(expected["score"], abs=2e-3)


def test_a_batch_over_http_shares_forward_passes(server: Server, traverse: str) -> None:
    passes = sample(server.client, "placerec_encoded_together_count")
    files = [(f"f{index}", ("f.jpg", jpeg(index % 8), "image/jpeg")) for index in range(16)]
    files[3] = ("f3", ("f.jpg", b"\xff\xd8\xff poison", "image/jpeg"))
    response = server.client.post(f"/v1/maps/{traverse}/query:batch", files=files)
    items = response.json()["items"]
    assert [item["file"] for item in items] == [f"f{index}" for index in range(16)]
    assert [item["status"] for item in items] == [200] * 3 + [422] + [200] * 12
    for index, item in enumerate(items):
        if index != 3:
            assert item["answer"]["matches"][0]["place"]["id"] == f"p{index % 8}"
    assert sample(server.client, "placerec_encoded_together_count") - passes <= 16 // MOST_BULK + cores()


def test_bulk_does_not_keep_a_robot_waiting(server: Server, traverse: str, map_id: str, tmp_path: Path) -> None:
    entries = [{"id": f"b{index}", "file": f"b{index}"} for index in range(80)]
    files = [(f"b{index}", ("b.jpg", jpeg(index % 50, 640, 480), "image/jpeg")) for index in range(80)]

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


def test_bulk_for_a_second_encoder_gets_its_turn(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(microbatches, "MOST_FRAMES", 2)
    monkeypatch.setattr(microbatches, "MOST_BULK", 2)
    order: list[object] = []
    robots = [watched.frame(seed, DEFAULT_ENCODER) for seed in range(12)]
    bulk = [watched.frame(seed, COARSE, bulk=True) for seed in range(2)]
    for name, frames in (("robot", robots), ("bulk", bulk)):
        for frame in frames:
            frame.result.add_done_callback(noting(order, name))
    watched.put_together([*bulk, *robots])
    for frame in (*robots, *bulk):
        frame.result.result(60)
    assert order.index("bulk") == 6, "three batches of robots, then theirs"
