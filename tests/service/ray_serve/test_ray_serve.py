"""Encoders in a Ray cluster on this machine, two processes: the same descriptors, and no frame lost with a process."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.errors import NotAnImage
from core.frames.images import Limits, decode
from core.frames.masks import Mask
from core.geometry.detection import find_keypoints
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import packaged_xfeat
from service.engine.queue import EncoderQueue, RequestDeadline
from service.errors.faults import ClientGone, DeadlineExceeded, NotReady
from service.ray_serve import encoders_for
from service.ray_serve.encoders import ATTEMPTS, RayEncoders
from service.settings import Settings
from service.telemetry.metrics import Metrics
from tests.service.ray_serve.robots import stays
from tests.service.scenes import jpeg
from tests.service.server import Server

pytestmark = [pytest.mark.anyio, pytest.mark.cluster]

IDENTITY = EncoderCatalogue().resolve(DEFAULT_ENCODER)
BATCH = 4
START_SECONDS = 180.0
MASK = Mask(polygons=(((0.0, 0.0), (1.0, 0.0), (1.0, 0.3)),))


@pytest.fixture(scope="module")
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="module")
def metrics() -> Metrics:
    return Metrics()


@pytest.fixture(scope="module")
def queue(metrics: Metrics, tmp_path_factory: pytest.TempPathFactory) -> Iterator[EncoderQueue]:
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("ray") / "data", ray=True, ray_replicas=2, ray_max_replicas=2, ray_batch=BATCH
    )

    made = EncoderQueue(EncoderCatalogue(), Limits(), 64, 0, metrics, encoders_for(settings))
    wait_for_replicas(made, 2)
    yield made
    made.close()


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return EncoderCatalogue().get(DEFAULT_ENCODER)


def wait_for_replicas(queue: EncoderQueue, count: int) -> None:
    until = time.monotonic() + START_SECONDS
    while time.monotonic() < until:
        if value(queue._metrics, "placerec_encoder_replicas") == count and queue.encoders.state == "ok":
            return
        time.sleep(0.1)
    raise AssertionError(queue.encoders.state)


def value(metrics: Metrics, name: str, **labels: str) -> float:
    return metrics.registry.get_sample_value(name, labels) or 0.0


def handle() -> Any:
    from ray import serve

    from service.ray_serve.cluster import APPLICATION

    return serve.get_app_handle(APPLICATION)


def pids(wanted: int) -> set[int]:
    """The processes of replicas that answer, once there are so many."""
    found: set[int] = set()
    for _ in range(100):
        if len(found) < wanted:
            found.add(handle().pid.remote().result(timeout_s=60))
    return found


def deadline(seconds: float = 120) -> RequestDeadline:
    return RequestDeadline(time.monotonic() + seconds, stays)


async def test_descriptors_are_those_of_the_embedded_encoder(queue: EncoderQueue, encoder: Encoder) -> None:
    for seed, mask in ((1, None), (2, MASK)):
        pixels = decode(jpeg(seed))
        wanted = encoder.encode(pixels, mask)
        asked = mask is not None  # the features of its regions are sent only if they are asked for
        found = await queue.encode(IDENTITY, jpeg(seed), deadline(), mask, keypoints=True, features=asked)
        np.testing.assert_array_equal(found.encoding.descriptor, wanted.descriptor)
        np.testing.assert_array_equal(found.encoding.local, wanted.local)
        np.testing.assert_array_equal(found.encoding.regions.boxes, wanted.regions.boxes)
        features = wanted.regions.features[:, : None if asked else 0]
        np.testing.assert_array_equal(found.encoding.regions.features, features)
        np.testing.assert_array_equal(found.pixels, pixels)
        points = find_keypoints(packaged_xfeat(), pixels, mask)
        assert found.keypoints is not None and found.keypoints.record() == points.record()
        assert set(found.milliseconds) == {"wait", "decode", "forward", "regions", "vlad", "keypoints"}


async def test_frames_that_wait_share_calls_and_fail_alone(queue: EncoderQueue, metrics: Metrics) -> None:
    calls, frames = (value(metrics, f"placerec_encoder_call_frames_{part}") for part in ("count", "sum"))
    await queue.encode(IDENTITY, jpeg(3), deadline())
    assert value(metrics, "placerec_encoder_call_frames_count") == calls + 1  # a frame alone waits for no other
    sent = [jpeg(seed) for seed in range(5)] * 6
    sent[7] = b"poison"
    found: dict[int, object] = {}
    async for some in queue.encode_many(IDENTITY, sent, deadline()):
        found |= dict(some)
    assert isinstance(found[7], NotAnImage)
    assert sum(isinstance(one, Exception) for one in found.values()) == 1 and len(found) == len(sent)
    assert value(metrics, "placerec_encoder_call_frames_sum") == frames + 1 + len(sent)
    # Each call had its fill but the first two, to replicas that had nothing to do, and the last ones.
    assert value(metrics, "placerec_encoder_call_frames_count") <= calls + 1 + len(sent) / BATCH + 4


async def test_nobody_waits_longer_than_its_deadline(queue: EncoderQueue, metrics: Metrics) -> None:
    async def leaves() -> None:
        await asyncio.sleep(0.05)

    before = value(metrics, "placerec_encode_stage_seconds_count", stage="vlad")
    ahead = [asyncio.ensure_future(queue.encode(IDENTITY, jpeg(seed % 5), deadline())) for seed in range(24)]
    with pytest.raises(DeadlineExceeded):
        await queue.encode(IDENTITY, jpeg(1), deadline(0.01))
    with pytest.raises(ClientGone):
        async for _ in queue.encode_many(IDENTITY, [jpeg(1)] * 24, RequestDeadline(time.monotonic() + 60, leaves)):
            pass
    for one in ahead[12:]:
        one.cancel()
    await asyncio.gather(*ahead[:12])
    await queue.encode(IDENTITY, jpeg(1), deadline())
    assert value(metrics, "placerec_encode_stage_seconds_count", stage="vlad") < before + 24 + 1 + 24


async def robots(queue: EncoderQueue, stop: asyncio.Event) -> int:
    """Frames that six robots get encoded, one after the other, until the event is set."""

    async def robot(number: int) -> int:
        count = 0
        while not stop.is_set():
            await queue.encode(IDENTITY, jpeg(number), deadline())
            count += 1
        return count

    return sum(await asyncio.gather(*(robot(number) for number in range(6))))


async def test_frames_of_a_killed_replica_are_encoded_by_another(queue: EncoderQueue) -> None:
    victim = min(await asyncio.to_thread(pids, 2))
    stop = asyncio.Event()
    load = asyncio.ensure_future(robots(queue, stop))
    await asyncio.sleep(1)
    os.kill(victim, signal.SIGSTOP)  # it still has frames, or gets some, when it is killed
    await asyncio.sleep(0.5)
    os.kill(victim, signal.SIGKILL)
    await asyncio.sleep(3)
    await asyncio.to_thread(wait_for_replicas, queue, 2)
    stop.set()
    assert await load > 12  # an error of any would have been raised
    assert victim not in await asyncio.to_thread(pids, 2)


async def test_a_rollout_fails_no_query(queue: EncoderQueue) -> None:
    assert isinstance(queue.encoders, RayEncoders)
    before = await asyncio.to_thread(pids, 2)
    stop = asyncio.Event()
    load = asyncio.ensure_future(robots(queue, stop))
    await asyncio.to_thread(queue.encoders._cluster.deploy)
    until = time.monotonic() + START_SECONDS
    while before & await asyncio.to_thread(pids, 2) and time.monotonic() < until:
        assert not load.done() and queue.encoders.state == "ok"
        await asyncio.sleep(0.5)
    stop.set()
    assert await load > 12
    assert not before & await asyncio.to_thread(pids, 2)


async def test_a_second_front_joins_and_answers_as_one_without_ray(queue: EncoderQueue, tmp_path: Path) -> None:
    import ray

    address = ray.get_runtime_context().gcs_address
    assert address.startswith("127.0.0.1:")
    settings = {"ray": "true", "ray_address": address, "drain_seconds": 30}
    answers = []
    for server in (Server(tmp_path / "ray", settings, forked=False), Server(tmp_path / "embedded")):
        server.wait()
        server.create_map("lab")
        for seed in range(6):
            assert server.enrol("lab", f"p{seed}", jpeg(seed)).status_code == 201
        answers.append([server.query("lab", jpeg(seed)) for seed in range(7)])
        server.process.send_signal(signal.SIGTERM)
        time.sleep(0.5)
        if len(answers) == 1:  # Ray would end the process at once
            assert server.client.get("/livez").status_code == 200
            assert server.stop() == 0  # a second signal
        else:
            assert server.process.wait(60) == 0
    for with_ray, without in zip(*answers, strict=True):
        assert with_ray["verdict"] == without["verdict"]
        for one, other in zip(with_ray["matches"], without["matches"], strict=True):
            assert (one["place"]["id"], one["score"], one["parts"]) == (
                other["place"]["id"],
                other["score"],
                other["parts"],
            )
    assert queue.encoders.state == "ok"  # the front that left took nothing with it


async def test_without_replicas_robots_are_refused_until_some_run_again(queue: EncoderQueue) -> None:
    from ray import serve

    from service.ray_serve.cluster import APPLICATION

    assert isinstance(queue.encoders, RayEncoders)
    await asyncio.to_thread(serve.delete, APPLICATION)
    with pytest.raises(NotReady, match="no encoder runs in the Ray cluster"):
        await queue.encode(IDENTITY, jpeg(1), deadline())
    assert queue.encoders.state != "ok"
    await asyncio.to_thread(queue.encoders._cluster.deploy)
    await asyncio.to_thread(wait_for_replicas, queue, 2)
    for _ in range(ATTEMPTS):
        await queue.encode(IDENTITY, jpeg(1), deadline())
