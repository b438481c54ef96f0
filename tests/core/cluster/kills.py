"""Kills of the parts of a cluster under a load: nothing is lost, nothing half-written, no answer is wrong.

    scripts/soak cluster --kills 100 --seed 7 [--minutes 15]

Two clients, one of them in a process of its own, write pairs of places in one batch each, forget places, and query; a
model in plain values knows what each place may show.  What is killed, or stands still for a while, and when, is drawn
at random.  After each kill, when both clients have been served again, the map is compared with the model, as a client
knows it and as one reads it that has just come.
"""

from __future__ import annotations

import logging
import os
import random
import statistics
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field

from core.errors import StorageFailure, UnknownMap
from core.store import open_cluster
from tests.campaigns import read_arguments
from tests.core.cluster.clients import ProcessClient, StoreClient
from tests.core.cluster.load import May, PlaceLoad, check, running
from tests.core.cluster.parts import PARTS, ClusterPart
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE
from tests.servers.postgres import Postgres, running_postgres

MOST_SECONDS = 60.0
"""From the start of a server, or the end of its silence, until both clients are served again."""
IDS = 12
SERVED = 5
"""Writes and queries of each client after which it is served again."""
GIVEN_UP = 120.0


@dataclass
class Recovery:
    """Seconds from the start of a part: until it answered at all, did its work for somebody who asks it directly, both
    clients had a write and a query answered, and ``SERVED`` of each; and the load of the machine then."""

    answered: float
    worked: float
    first: float
    served: float
    load: float

    def __str__(self) -> str:
        times = f"answered {self.answered:.1f} s, worked {self.worked:.1f} s, first served {self.first:.1f} s"
        return f"{times}, {SERVED} times {self.served:.1f} s after its start, load {self.load:.0f}"


@dataclass
class Tally:
    """The sum of a campaign; ``looks`` at batches without an answer, ``recoveries`` by part."""

    answered: int = 0
    looks: int = 0
    refused: int = 0
    recoveries: dict[str, list[Recovery]] = field(default_factory=dict)

    def __str__(self) -> str:
        kills = sum(map(len, self.recoveries.values()))
        said = (
            f"{kills} kills, {self.answered} answered, {self.refused} refused, {self.looks} batches without an answer"
        )
        return said + "".join(
            f"\n  {part}, {len(these)} kills: answers after {_middle([one.answered for one in these])}, works after"
            f" {_middle([one.worked for one in these])}, clients are first served"
            f" {_middle([max(0.0, one.first - one.worked) for one in these])} later, and {SERVED} times after"
            f" {_middle([one.served for one in these])} in all, under a load of"
            f" {statistics.median(one.load for one in these):.0f}"
            for part, these in self.recoveries.items()
        )


def _middle(seconds: Sequence[float]) -> str:
    return f"{statistics.median(seconds):.1f} s (at most {max(seconds):.1f})"


class ClusterKills:
    """A map ``lab`` in a cluster, its model, and two clients."""

    def __init__(self, postgres: Postgres, seed: str) -> None:
        self._seed, self._address = seed, postgres.address
        self._store = open_cluster(self._address)
        with suppress(UnknownMap):
            self._store.delete("lab")
        self._lab = self._store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
        self._client = ProcessClient(self._address)
        self._may: list[May] = [{f"{letter}{number}": {None} for number in range(IDS)} for letter in "pq"]
        self.parts = {name: made(postgres, self._client) for name, made in PARTS.items()}
        self.tally, self._kills = Tally(), Counter[str]()

    def kill(self, part: str) -> Recovery:
        """Kill a part under the load, start it again, wait until both are served, and compare."""
        number = sum(self._kills.values())
        self._kills[part] += 1
        seed = f"{self._seed}/{number}"
        draw = random.Random(seed)
        self._lab.edit({"index": draw.choice(("exact", "compact"))})
        clients: tuple[StoreClient | ProcessClient, ...] = StoreClient(self._store), self._client
        loads = [
            PlaceLoad(client, f"{seed}/{n}", may)
            for n, (client, may) in enumerate(zip(clients, self._may, strict=True))
        ]
        with running(loads):
            time.sleep(draw.uniform(0.2, 2.0))
            killed = self.parts[part]
            self._store.sweep()  # must not take anything that counts
            killed.kill(draw)
            began = time.monotonic()
            killed.start()
            answered = time.monotonic() - began
            before = [load.done for load in loads]
            worked: list[float] = []
            asking = threading.Thread(target=lambda: worked.append(_works_at(killed) - began))
            asking.start()
            first, served = (_served_at(loads, before, times, began + GIVEN_UP, part) - began for times in (1, SERVED))
            asking.join()
            recovery = Recovery(answered, min(worked[0], first), first, served, os.getloadavg()[0])
            self.tally.recoveries.setdefault(part, []).append(recovery)
        for load in loads:
            assert not load.wrong, load.wrong
            self.tally.answered += sum(load.done)
            self.tally.looks += load.looks
            self.tally.refused += load.refused
        whole = self._may[0] | self._may[1]
        check(self._lab, whole)
        with closing(open_cluster(self._address)) as fresh:
            check(fresh.get("lab"), whole)
            report = fresh.verify("lab")
            assert report.ok, report.problems
        for may in self._may:
            may.update({name: whole[name] for name in may})
        return recovery

    def close(self) -> None:
        """Delete the map and end the clients."""
        self._client.close()
        with suppress(UnknownMap):
            self._store.delete("lab")
        self._store.close()


def _served_at(
    loads: Sequence[PlaceLoad], before: Sequence[tuple[int, int]], times: int, until: float, part: str
) -> float:
    """When all clients have been served so many times."""
    while not all(load.served(then, times) for load, then in zip(loads, before, strict=True)):
        assert all(load.is_alive() for load in loads), "a client is gone"
        assert time.monotonic() < until, f"{part} is back, but clients are not served"
        time.sleep(0.02)
    return time.monotonic()


def _works_at(part: ClusterPart) -> float:
    """When a part does its work again."""
    until = time.monotonic() + GIVEN_UP
    while time.monotonic() < until:
        try:
            part.ask()
            break
        except StorageFailure:
            time.sleep(0.2)
    return time.monotonic()


def main(arguments: Sequence[str]) -> int:
    """Kill until there were enough kills, or the time is over."""
    chosen = read_arguments(arguments, "cluster", __doc__, PARTS, kills=100)
    seed = chosen.seed
    logging.disable(logging.CRITICAL)  # that parts are away is no news here
    draw, began = random.Random(seed), time.monotonic()
    with running_postgres() as postgres, closing(ClusterKills(postgres, seed)) as campaign:
        for number in range(1, chosen.kills + 1):
            part = draw.choice(chosen.parts)
            print(number, part, campaign.kill(part), flush=True)
            if number % 5 == 0:
                print(campaign.tally, flush=True)
            if chosen.minutes is not None and time.monotonic() - began > 60 * chosen.minutes:
                break
    of_servers = [these for part, these in campaign.tally.recoveries.items() if campaign.parts[part].is_server]
    slowest = max((one.served for these in of_servers for one in these), default=0.0)
    kept = "kept" if slowest <= MOST_SECONDS else "MISSED"
    print(f"{campaign.tally}\nnothing lost, nothing half-written, no wrong answer")
    print(f"served again within {MOST_SECONDS:g} s of a server's start: {kept}")
    return 0 if slowest <= MOST_SECONDS else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
