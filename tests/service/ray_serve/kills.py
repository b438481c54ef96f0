"""Kills of the nodes of a Ray cluster and of processes that encode, under a load: no answer is lost or wrong.

    scripts/soak ray --kills 20 --seed 7 [--minutes 15]

A head that computes nothing and two nodes; robots ask a front without a pause.  What is killed, and when, is drawn at
random: a process that encodes, or a node that has such processes.  No frame is lost; each answer has the same bits as
without Ray; and all are served again within ``MOST_SECONDS`` of the return of what was killed.  The front is on the
machine of the head, for Ray may end a process whose own machine leaves the cluster.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import random
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from core.frames.images import Limits
from core.method.catalogue import EncoderCatalogue
from service.engine.queue import EncoderQueue
from service.ray_serve import encoders_for
from service.settings import Settings
from service.telemetry.metrics import Metrics
from tests.campaigns import read_arguments
from tests.service.ray_serve.nodes import Node, Nodes
from tests.service.ray_serve.robots import Robots
from tests.service.ray_serve.test_ray_serve import pids, wait_for_replicas

PARTS = ("encoder", "node")
MOST_SECONDS = 30.0
"""From the return of what was killed until every robot is answered again."""


class Campaign:
    """A cluster, a front of it, and what became of the kills.

    seconds: by part, from the return of each that was killed until every robot was answered again.
    """

    def __init__(self, nodes: Nodes, queue: EncoderQueue, chance: random.Random) -> None:
        self._nodes, self._queue, self._chance = nodes, queue, chance
        while "no encoder runs" not in queue.encoders.state:  # it has joined, by the only machine that there is
            time.sleep(0.1)
        self._workers = [nodes.add(1), nodes.add(1)]
        self.seconds: dict[str, list[float]] = {}
        self.answered = 0

    async def kill(self, part: str) -> None:
        """Kill a part under the load, start it again, and wait until all are served."""
        async with Robots(self._queue) as robots:
            await asyncio.sleep(self._chance.uniform(0.2, 2.0))
            if part == "encoder":
                os.kill(self._chance.choice(sorted(await asyncio.to_thread(pids, 2))), signal.SIGKILL)
            else:
                self._workers.pop(self._chance.randrange(2)).kill()
                self._workers.append(await self._added())
            self.seconds.setdefault(part, []).append(await robots.all_served())
        assert not robots.refused, f"{robots.refused} refused"
        self.answered += robots.answered
        while len(await asyncio.to_thread(pids, 2)) < 2:  # else the next kill could leave none, and frames be refused
            await asyncio.sleep(0.2)

    async def _added(self) -> Node:
        return await asyncio.to_thread(self._nodes.add, 1)

    def __str__(self) -> str:
        times = [
            f"{part} {len(these)} kills, served again after {statistics.median(these):.1f} s (at most {max(these):.1f})"
            for part, these in self.seconds.items()
        ]
        kills = sum(map(len, self.seconds.values()))
        return f"{kills} kills, {self.answered} answered, none refused; {'; '.join(times)}"


async def run(nodes: Nodes, chosen: argparse.Namespace) -> int:
    """Kill until there were enough kills, or the time is over."""
    draw, began = random.Random(chosen.seed), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(
            data_dir=Path(folder) / "data", ray=True, ray_address=nodes.address, ray_replicas=2, ray_max_replicas=2
        )
        catalogue = EncoderCatalogue()
        queue = EncoderQueue(catalogue, Limits(), 64, 0, Metrics(), encoders_for(settings))
        try:
            campaign = await asyncio.to_thread(Campaign, nodes, queue, random.Random(chosen.seed))
            await asyncio.to_thread(wait_for_replicas, queue, 2)
            for _ in range(chosen.kills):
                await campaign.kill(draw.choice(chosen.parts))
                print(campaign, flush=True)
                if chosen.minutes is not None and time.monotonic() - began > 60 * chosen.minutes:
                    break
        finally:
            await asyncio.to_thread(queue.close)
    return int(any(max(these) > MOST_SECONDS for these in campaign.seconds.values()))


def main(arguments: Sequence[str]) -> int:
    """Start a cluster and kill its parts."""
    chosen = read_arguments(arguments, "ray", __doc__, PARTS, kills=20)
    with Nodes() as nodes:
        return asyncio.run(run(nodes, chosen))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
