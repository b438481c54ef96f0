"""A bad network between the client and the service: nothing is lost, and nothing happens twice."""

from __future__ import annotations

import asyncio
import random
from collections import Counter

import pytest

from placerec_client import AsyncClient, AsyncMap, NewPlace, Retry
from tests.clients.python.fault_proxy import FAULTS, FaultProxy
from tests.fuzz.encoder import SMALL
from tests.service.scenes import jpeg
from tests.service.server import Server

PATIENT = Retry(patience=60, first_pause=0.02, longest_pause=0.5)
KINDS = ("put", "put", "query", "query", "frame", "frame", "edit", "forget", "enrol", "map", "batch")
WORKERS = 6
SCENES = 8


class Campaign:
    """Operations of several workers on one map, and what must have come of them.

    Args:
        lab: the map, reached through the proxy.
        seed: of the order of the operations.
    """

    def __init__(self, client: AsyncClient, lab: AsyncMap, seed: int) -> None:
        self._client, self._lab, self._random = client, lab, random.Random(seed)
        self.places: dict[str, float | None] = {}  # id and x of each place that must be there
        self.lines: dict[str, list[str]] = {}  # the places of each sequence, in order
        self.frames: Counter[str] = Counter()
        self.maps: set[str] = set()
        self.done: Counter[str] = Counter()

    async def work(self, worker: int, operations: int) -> None:
        """Do so many operations, the frames of one session and one stream among them."""
        async with self._lab.sessions.begin(expires_after=600) as session, session.stream() as stream:
            for number in range(operations):
                kind = self._random.choice(KINDS)
                self.done[kind] += 1
                name = f"w{worker}-{number}"
                if kind == "frame":
                    sender = stream if self._random.random() < 0.5 else session
                    answer = await sender.send(jpeg(number % SCENES, 64, 48))
                    self.frames[session.id] += 1
                    assert answer.frames == self.frames[session.id]
                else:
                    await getattr(self, f"_{kind}")(name, number)
            report = await session.read()
            assert report.frames == self.frames[session.id]

    async def _put(self, name: str, number: int) -> None:
        place = await self._lab.places.put(name, jpeg(100 + number, 64, 48), x=float(number), y=0, sequence=name)
        assert place.change in ("created", "unchanged")
        self.places[name], self.lines[name] = number, [name]

    async def _query(self, name: str, number: int) -> None:
        answer = await self._lab.query(jpeg(number % SCENES, 64, 48), sequences=["base"])
        assert answer.matches[0].place.id == f"base-{number % SCENES}"

    async def _edit(self, name: str, number: int) -> None:
        await self._put(name, number)
        edited = await self._lab.places.edit(name, {"pose": {"x": number + 0.5}})
        assert edited.pose is not None and edited.pose.x == number + 0.5
        self.places[name] = number + 0.5

    async def _forget(self, name: str, number: int) -> None:
        await self._put(name, number)
        await self._lab.places.delete(name)
        del self.places[name], self.lines[name]

    async def _enrol(self, name: str, number: int) -> None:
        ids = [f"{name}-{index}" for index in range(3)]
        frames = [NewPlace(one, jpeg(200 + number, 64, 48), {"sequence": name}) for one in ids]
        changes = [outcome.change for outcome in await self._lab.enrol(frames, known=())]
        assert set(changes) <= {"created", "unchanged"} and len(changes) == 3
        self.places.update(dict.fromkeys(ids))
        self.lines[name] = ids

    async def _batch(self, name: str, number: int) -> None:
        frames = [jpeg(index, 64, 48) for index in range(3)]
        found = [one.answer async for one in self._lab.query_batch(frames, sequences="base")]
        assert [one and one.matches[0].place.id for one in found] == [f"base-{index}" for index in range(3)]

    async def _map(self, name: str, number: int) -> None:
        made = await self._client.maps.create(f"{self._lab.id}-{name}", description=name)
        view = await made.edit({"description": "edited"}, if_match=(await made.read()).revision)
        assert view.description == "edited"
        if number % 2:
            await made.delete()
        else:
            self.maps.add(made.id)


def campaign(server: Server, map_id: str, operations: int, seed: int) -> FaultProxy:
    """Do so many operations through a bad network, and compare what the service then has with what it must have."""
    server.create_map(map_id, keep="none", encoder=SMALL)
    for number in range(SCENES):
        server.enrol(map_id, f"base-{number}", jpeg(number, 64, 48), sequence="base")
    with FaultProxy(server.port, seed=seed) as proxy:

        async def work() -> Campaign:
            async with AsyncClient(proxy.url, retry=PATIENT, timeout=20) as client:
                made = Campaign(client, client.maps[map_id], seed)
                await asyncio.gather(*(made.work(worker, operations // WORKERS) for worker in range(WORKERS)))
                return made

        done = asyncio.run(work())
    assert done.done.total() == operations // WORKERS * WORKERS
    there = {name: place for name, place in server.places(map_id).items() if not name.startswith("base-")}
    assert {name: place["pose"] and place["pose"]["x"] for name, place in there.items()} == done.places
    lines: dict[str, list[str]] = {}
    for name, place in there.items():
        lines.setdefault(place["sequence"], []).append(name)
    assert lines == done.lines
    maps = {one["id"] for one in server.client.get("/v1/maps?limit=1000").json()["items"]}
    assert {name for name in maps if name.startswith(f"{map_id}-")} == done.maps
    return proxy


@pytest.mark.thorough
def test_a_bad_network_loses_and_doubles_nothing(server: Server) -> None:
    proxy = campaign(server, "bad-network", 120, seed=17)
    assert all(proxy.happened[fault] for fault in (*FAULTS, "cut-stream")), proxy.happened


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", range(3))
def test_a_thousand_operations(server: Server, seed: int) -> None:
    """Run as ``scripts/test tests/clients/python/test_faults.py -m soak``."""
    proxy = campaign(server, f"thousand-{seed}", 1002, seed)
    print(dict(proxy.happened))
