"""Kills of the parts of a cluster under a load: nothing is lost, nothing half-written, no answer is wrong.

    scripts/soak cluster --kills 100 --seed 7 [--minutes 15]

Two clients, one of them in a process of its own, write pairs of places in one batch each, forget places, and query; a
model in plain values knows what each place may show.  What is killed, and when, is drawn at random.  After each kill,
when both clients have been served again, the map is compared with the model.
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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np

from core.errors import StorageFailure, UnknownMap, UnknownPlace
from core.milvus import open_store
from core.milvus.map import MilvusMap
from tests.campaigns import read_arguments
from tests.core.milvus.clients import Client, ProcessClient
from tests.core.milvus.parts import PARTS, Part
from tests.core.storage.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, digest_of
from tests.servers.milvus import Servers, running_servers

MOST_SECONDS = 60.0
"""From the start of a server until both clients are served again."""
IDS = 12
SERVED = 5
"""Writes and queries of each client after which it is served again."""
GIVEN_UP = 120.0

May = dict[str, set[str | None]]
"""By id, the pictures that the place may show, None for no place: one, unless a write got no answer."""


class Load(threading.Thread):
    """Writes, forgets and queries, and notes in ``may`` what each of its places may show."""

    def __init__(self, client: Client | ProcessClient, seed: str, may: May) -> None:
        super().__init__(daemon=True)
        self._client, self._random, self.may = client, random.Random(seed), may
        self._over = threading.Event()
        self.answered = self.queries = self.refused = 0
        self.wrong: list[str] = []

    def stop(self) -> None:
        self._over.set()
        self.join()

    def served(self, since: tuple[int, int], times: int) -> bool:
        """Whether it had so many writes and so many queries answered since ``done`` was so."""
        return all(now >= then + times for now, then in zip(self.done, since, strict=True))

    @property
    def done(self) -> tuple[int, int]:
        """Writes and queries that were answered."""
        return self.answered, self.queries

    def run(self) -> None:
        before: May = {}
        while not self._over.is_set():
            ids = self._random.sample(sorted(self.may), 2)
            picture: str | None = f"picture {self._random.randrange(10**9)}"
            try:
                if self._random.random() < 0.3:
                    self._query()
                    continue
                if self._random.random() < 0.2:
                    ids, picture = ids[:1], None
                before = {name: self.may[name] for name in ids}
                if picture is None and before[ids[0]] == {None}:
                    continue
                for name in ids:  # until the answer comes, both may be found
                    self.may[name] = before[name] | {picture}
                if picture is None:
                    self._client.forget(ids[0])
                else:
                    self._client.enrol(ids, picture)
                for name in ids:
                    self.may[name] = {picture}
                self.answered += 1
            except UnknownPlace:  # it was forgotten by a write that got no answer
                if None not in before[ids[0]]:
                    self.wrong.append(f"{ids[0]}, which shows one of {before[ids[0]]}, is lost")
                self.may[ids[0]] = {None}
            except StorageFailure:
                self.refused += 1
                time.sleep(0.05)

    def _query(self) -> None:
        """A place whose picture is known is found first by it, and what is kept of it shows it."""
        known = [name for name, shows in self.may.items() if len(shows) == 1 and None not in shows]
        if known:
            name = self._random.choice(known)
            (picture,) = self.may[name]
            # Both places of a batch show the same picture; another place cannot be as near.
            first = self._client.first(str(picture))
            if name not in first:
                self.wrong.append(f"{name} with {picture} is not among {first}")
            self.queries += 1
            if self._random.random() < 0.3 and (kept := self._client.picture(name)) != f"thumbnail of {picture}":
                self.wrong.append(f"{name} with {picture} keeps {kept!r}")


@contextmanager
def running(loads: Sequence[Load]) -> Iterator[None]:
    for load in loads:
        load.start()
    try:
        yield
    finally:
        for load in loads:
            load.stop()


def check(lab: MilvusMap, may: May) -> None:
    """Every place shows what it may show, is stored whole and is found."""
    outline, snapshot = lab.transfer.outline(), lab.snapshot()
    found = {place.id: place for place in outline}
    assert len(snapshot) == len(found)
    for name, shows in may.items():
        pictures = {digest_of(picture): picture for picture in shows if picture is not None}
        assert name in found or None in shows, f"{name}, which shows one of {shows}, is lost"
        if name not in found:
            may[name] = {None}
            continue
        place = found[name]
        assert place.digest in pictures, f"{name} shows none of {shows}"
        picture = pictures[place.digest]
        row = np.array([place.row])
        assert np.allclose(snapshot.descriptors_at(row)[0], descriptor_of(picture), atol=1e-3)
        assert snapshot.locals_at(row).any() and lab.picture(name) == f"thumbnail of {picture}".encode()
        ((rows, _),) = lab.scope().search(descriptor_of(picture)[np.newaxis])
        assert place.row in rows[:2].tolist()
        may[name] = {picture}


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
    """What a campaign did; ``recoveries`` by part."""

    answered: int = 0
    refused: int = 0
    recoveries: dict[str, list[Recovery]] = field(default_factory=dict)

    def __str__(self) -> str:
        kills = sum(map(len, self.recoveries.values()))
        return f"{kills} kills, {self.answered} answered, {self.refused} refused" + "".join(
            f"\n  {part}, {len(these)} kills: answers after {_middle([one.answered for one in these])}, works after"
            f" {_middle([one.worked for one in these])}, clients are first served"
            f" {_middle([max(0.0, one.first - one.worked) for one in these])} later, and {SERVED} times after"
            f" {_middle([one.served for one in these])} in all, under a load of"
            f" {statistics.median(one.load for one in these):.0f}"
            for part, these in self.recoveries.items()
        )


def _middle(seconds: Sequence[float]) -> str:
    return f"{statistics.median(seconds):.1f} s (at most {max(seconds):.1f})"


class Campaign:
    """A map ``lab`` in a store, its model, and two clients."""

    def __init__(self, servers: Servers, seed: str) -> None:
        self._seed = seed
        self._store = open_store(servers.milvus_address, servers.postgres_address, bucket=servers.bucket)
        with suppress(UnknownMap):
            self._store.delete("lab")
        self._lab = self._store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
        self._client = ProcessClient(servers.milvus_address, servers.postgres_address, servers.bucket)
        self._may: list[May] = [{f"{letter}{number}": {None} for number in range(IDS)} for letter in "pq"]
        self.parts = {name: made(servers, self._client) for name, made in PARTS.items()}
        self.tally, self._kills, self._served = Tally(), Counter[str](), dict[str, float]()

    def kill(self, part: str) -> Recovery:
        """Kill a part under the load, start it again, wait until both are served, and compare."""
        number = sum(self._kills.values())
        self._kills[part] += 1
        seed = f"{self._seed}/{number}"
        clients: tuple[Client | ProcessClient, ...] = Client(self._store), self._client
        loads = [
            Load(client, f"{seed}/{n}", may) for n, (client, may) in enumerate(zip(clients, self._may, strict=True))
        ]
        with running(loads):
            time.sleep(random.Random(seed).uniform(0.2, 2.0))
            killed = self.parts[part]
            time.sleep(max(0.0, self._served.get(part, 0.0) + killed.lives - time.monotonic()))
            self._store.sweep_objects()  # must not take anything that counts
            killed.kill()
            began = time.monotonic()
            killed.start()
            answered = time.monotonic() - began
            before = [load.done for load in loads]
            worked: list[float] = []
            asking = threading.Thread(target=lambda: worked.append(_works_at(killed) - began))
            asking.start()
            first, served = (_served_at(loads, before, times, began + GIVEN_UP, part) - began for times in (1, SERVED))
            self._served[part] = time.monotonic()
            asking.join()
            recovery = Recovery(answered, min(worked[0], first), first, served, os.getloadavg()[0])
            self.tally.recoveries.setdefault(part, []).append(recovery)
        for load in loads:
            assert not load.wrong, load.wrong
            self.tally.answered += sum(load.done)
            self.tally.refused += load.refused
        whole = self._may[0] | self._may[1]
        check(self._lab, whole)
        for may in self._may:
            may.update({name: whole[name] for name in may})
        return recovery

    def close(self) -> None:
        """Delete the map and end the clients."""
        self._client.close()
        with suppress(UnknownMap):
            self._store.delete("lab")
        self._store.close()


def _served_at(loads: Sequence[Load], before: Sequence[tuple[int, int]], times: int, until: float, part: str) -> float:
    """When all clients have been served so many times."""
    while not all(load.served(then, times) for load, then in zip(loads, before, strict=True)):
        assert all(load.is_alive() for load in loads), "a client is gone"
        assert time.monotonic() < until, f"{part} is back, but clients are not served"
        time.sleep(0.02)
    return time.monotonic()


def _works_at(part: Part) -> float:
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
    with running_servers() as servers:
        campaign = Campaign(servers, seed)
        try:
            for number in range(1, chosen.kills + 1):
                part = draw.choice(chosen.parts)
                print(number, part, campaign.kill(part), flush=True)
                if number % 5 == 0:
                    print(campaign.tally, flush=True)
                if chosen.minutes is not None and time.monotonic() - began > 60 * chosen.minutes:
                    break
        finally:
            campaign.close()
    of_servers = [these for part, these in campaign.tally.recoveries.items() if campaign.parts[part].is_server]
    slowest = max((one.served for these in of_servers for one in these), default=0.0)
    kept = "kept" if slowest <= MOST_SECONDS else "MISSED"
    print(f"{campaign.tally}\nnothing lost, nothing half-written, no wrong answer")
    print(f"served again within {MOST_SECONDS:g} s of a server's start: {kept}")
    return 0 if slowest <= MOST_SECONDS else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
