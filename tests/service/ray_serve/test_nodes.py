"""Encoders on several nodes of Ray: one is killed under a load, replicas grow and shrink with it, all are killed."""

from __future__ import annotations

import asyncio
import hashlib
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.ray_serve.waiting import WaitingReplica, prepare
from core.frames.images import Limits, decode
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from service.engine.queue import EncoderQueue
from service.ray_serve import encoders_for
from service.ray_serve.cluster import Cluster
from service.ray_serve.encoders import RayEncoders
from service.settings import Settings
from service.telemetry.metrics import Metrics
from tests.service.ray_serve.front import Front
from tests.service.ray_serve.nodes import Node, Nodes
from tests.service.ray_serve.robots import Robots
from tests.service.ray_serve.test_ray_serve import BATCH, IDENTITY, deadline, pids, value, wait_for_replicas
from tests.service.scenes import jpeg

pytestmark = [pytest.mark.anyio, pytest.mark.cluster, pytest.mark.timeout(900)]

MILLISECONDS = 200
"""A frame takes a waiting encoder so long."""


@pytest.fixture(scope="module")
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="module")
def nodes() -> Iterator[tuple[Nodes, list[Node]]]:
    with Nodes() as found:
        yield found, [found.add(1), found.add(1)]


@pytest.fixture(scope="module")
def settings(nodes: tuple[Nodes, list[Node]], tmp_path_factory: pytest.TempPathFactory) -> Settings:
    folder = tmp_path_factory.mktemp("nodes")
    prepare(folder / "models", DEFAULT_ENCODER, MILLISECONDS)
    return Settings(
        data_dir=folder / "data",
        ray=True,
        ray_address=nodes[0].address,
        ray_replicas=2,
        ray_max_replicas=2,
        ray_batch=BATCH,
        ray_scale_seconds=0.5,
    )


@pytest.fixture(scope="module")
def queue(settings: Settings) -> Iterator[EncoderQueue]:
    made = EncoderQueue(EncoderCatalogue(), Limits(), 64, 0, Metrics(), encoders_for(settings))
    wait_for_replicas(made, 2)
    yield made
    made.close()


async def test_a_killed_node_loses_no_frame_and_a_new_one_takes_over(
    queue: EncoderQueue, nodes: tuple[Nodes, list[Node]]
) -> None:
    cluster, (kept, lost) = nodes
    encode = await asyncio.to_thread(pids, 2)
    assert len(encode & kept.processes()) == len(encode & lost.processes()) == 1

    async with Robots(queue) as robots:
        lost.kill()
        added = await asyncio.to_thread(cluster.add, 1)
        until = time.monotonic() + 120
        while not added.processes() & await asyncio.to_thread(pids, 2):
            assert time.monotonic() < until, "no encoder runs on the new node"
        await robots.all_served()
    assert not robots.refused


async def test_encoders_grow_with_the_queue_and_shrink_without(queue: EncoderQueue, settings: Settings) -> None:
    def replicas() -> float:
        return value(queue._metrics, "placerec_encoder_replicas")

    fewest = Cluster(settings.model_copy(update={"ray_replicas": 1}), Limits())
    await asyncio.to_thread(fewest.deploy, WaitingReplica)
    until = time.monotonic() + 120
    while replicas() != 1:
        assert time.monotonic() < until, "idle encoders go on"
        await asyncio.sleep(0.2)
    asked: set[asyncio.Future[object]] = set()
    try:
        while replicas() != 2:
            assert time.monotonic() < until, "no encoder is added"
            asked = {one for one in asked if not one.done()}
            while len(asked) < 4 * BATCH:
                asked.add(asyncio.ensure_future(queue.encode(IDENTITY, jpeg(1), deadline())))
            await asyncio.sleep(0.2)
    finally:
        await asyncio.gather(*asked)
    while replicas() != 1:
        assert time.monotonic() < until, "an idle encoder goes on"
        await asyncio.sleep(0.2)
    assert isinstance(queue.encoders, RayEncoders)
    await asyncio.to_thread(queue.encoders._cluster.deploy)
    await asyncio.to_thread(wait_for_replicas, queue, 2)


async def test_a_front_serves_again_when_its_cluster_returns(tmp_path: Path) -> None:
    wanted = EncoderCatalogue().get(DEFAULT_ENCODER).encode(decode(jpeg(1))).descriptor
    expected = hashlib.sha256(wanted.tobytes()).hexdigest()

    def served(front: Front, within: float) -> None:
        until = time.monotonic() + within
        while not (found := front.ask(1)):
            assert time.monotonic() < until, "no frame is encoded"
            time.sleep(0.5)
        assert found == expected

    def run() -> None:
        with Nodes() as cluster, Front(cluster.address, tmp_path) as front:
            cluster.add(1)
            served(front, 180)
            cluster.kill()
            while front.ask(1):
                pass
            cluster.start_head()
            cluster.add(1)
            served(front, 180)

    await asyncio.to_thread(run)
