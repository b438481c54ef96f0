"""A fleet that works on one map for a given time: robots, operators who enrol, one who deletes, housekeeping.

Standard library and bytes made beforehand, like :mod:`service.commands.load`, but every answer is read and judged: a
place that was enrolled before a frame was sent, and whose deletion was not begun before the answer came, must be the
best match of its own scene; one whose deletion was acknowledged before the frame was sent must not occur at all.

Robots keep to a timetable.  The time of an answer counts from when its frame was due, so that a robot that had
to wait for the answer before does not hide the wait.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter, deque
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from urllib.parse import urlsplit

PLACES_OF_A_TRAVERSE = 40
RETAINED_TRAVERSES = 4
"""Of each operator; older ones are deleted, those with an even number place by place, the others as a whole."""

BATCH = 8
HOUSEKEEPING_SECONDS = 10.0
NEVER = float("inf")


@dataclass
class PlaceHistory:
    """The known history of one place: when its enrolment was acknowledged, its deletion begun and acknowledged."""

    scene: int
    since: float = NEVER
    leaving: float = NEVER
    gone: float = NEVER


@dataclass
class EnrolledTraverse:
    """Places that one operator enrolled one after the other."""

    name: str
    index: int
    places: list[str] = field(default_factory=list)


@dataclass
class Scene:
    """Two JPEG files of one place: the one to enrol, and how a robot sees it later."""

    enrolled: bytes
    seen: bytes


@dataclass
class Workload:
    """The work of the fleet, and its means.

    rate: frames a second of each robot; 0: the next as soon as the last is answered.
    enrol_rate: frames a second of each operator.
    fixed: places that are never deleted, by id, with the number of their scene.
    """

    url: str
    map_id: str
    scenes: list[Scene]
    strangers: list[bytes]
    fixed: dict[str, int]
    robots: int = 16
    operators: int = 2
    rate: float = 4.0
    enrol_rate: float = 2.0


@dataclass
class Seen:
    """The results: (when due, seconds) by kind of request, statuses, and complaints in words."""

    times: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    statuses: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    complaints: Counter[str] = field(default_factory=Counter)

    def note(self, kind: str, due: float, status: int, expected: tuple[int, ...], body: bytes) -> bool:
        """One answer; whether its status is one that was to be expected."""
        self.times.setdefault(kind, []).append((due, time.perf_counter() - due))
        self.statuses[f"{kind} {status}"] += 1
        if status not in expected:
            self.complaints[f"{kind}: {status} {body[:300].decode(errors='replace')}"] += 1
        return status in expected


class PersistentConnection:
    """One persistent connection, opened again when the other end has closed it between two requests.

    Args:
        headers: lines of every request, each with its end of line.
    """

    def __init__(self, url: str, headers: str = "") -> None:
        parts = urlsplit(url)
        self._headers = headers
        self._host, self._port = str(parts.hostname), parts.port or 80
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def request(
        self, method: str, path: str, body: bytes = b"", kind: str = "image/jpeg", keep: bool = True
    ) -> tuple[int, bytes]:
        """Status and body of the answer; without ``keep`` only the length of the body, as text.

        Raises:
            OSError, EOFError: the service hung up on a request under way.
        """
        head = f"{method} {path} HTTP/1.1\r\nHost: {self._host}:{self._port}\r\nContent-Length: {len(body)}\r\n"
        head += self._headers + (f"Content-Type: {kind}\r\n\r\n" if body else "\r\n")
        if self._streams is None or self._streams[0].at_eof():
            self.close()
            self._streams = await asyncio.open_connection(self._host, self._port)
        reader, writer = self._streams
        writer.write(head.encode() + body)
        await writer.drain()
        fields = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
        status = int(fields.split(" ", 2)[1])
        if "transfer-encoding: chunked" in fields:
            content = await _chunks(reader, keep)
        else:
            length = int(fields.partition("content-length:")[2].partition("\r\n")[0] or 0)
            content = await _counted(reader, length, keep)
        if "connection: close" in fields:
            self.close()
        return status, content

    def close(self) -> None:
        """Hang up."""
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


async def _counted(reader: asyncio.StreamReader, length: int, keep: bool) -> bytes:
    if keep:
        return await reader.readexactly(length)
    left = length
    while left:
        part = await reader.read(min(left, 1 << 20))
        if not part:
            raise EOFError("the answer ends early")
        left -= len(part)
    return str(length).encode()


async def _chunks(reader: asyncio.StreamReader, keep: bool) -> bytes:
    parts, total = [], 0
    while size := int((await reader.readline()).split(b";")[0], 16):
        part = await reader.readexactly(size + 2)
        total += size
        if keep:
            parts.append(part[:-2])
    await reader.readline()
    return b"".join(parts) if keep else str(total).encode()


class Fleet:
    """All who work on the map."""

    def __init__(self, plan: Workload) -> None:
        """Nobody works yet."""
        self.plan, self.seen = plan, Seen()
        self.places = {place: PlaceHistory(scene, since=0.0) for place, scene in plan.fixed.items()}
        self.of_scene: dict[int, str] = {scene: place for place, scene in plan.fixed.items()}
        self.until = NEVER
        self.unsent = 0
        """Frames that were due and could not be sent in time."""
        self._free = deque(n for n in range(len(plan.scenes)) if n not in self.of_scene)
        self._traverses: dict[int, list[EnrolledTraverse]] = {n: [] for n in range(plan.operators)}
        self._serial = count()
        self._root = f"/v1/maps/{plan.map_id}"

    def alive(self) -> int:
        """How many places the map must hold, those under way left out."""
        return sum(place.since < NEVER and place.gone == NEVER for place in self.places.values())

    async def fill(self) -> None:
        """The traverses that each operator keeps, at once."""
        for number in range(self.plan.operators):
            line = PersistentConnection(self.plan.url)
            for _ in range(RETAINED_TRAVERSES * PLACES_OF_A_TRAVERSE // BATCH):
                await self._enrol_many(line, number, BATCH, time.perf_counter())
            line.close()

    async def work(self, seconds: float, exports: bool) -> None:
        """Let all of them work for this time; the results are in ``seen``."""
        self.until = time.perf_counter() + seconds
        hands: list[Awaitable[None]] = [self._guarded("query", self._robot, n) for n in range(self.plan.robots)]
        hands += [self._guarded("enrol", self._operator, n) for n in range(self.plan.operators)]
        hands += [self._guarded("delete", self._deleter, 0), self._guarded("keep", self._keeper, int(exports))]
        await asyncio.gather(*hands)

    async def _guarded(
        self, kind: str, hand: Callable[[PersistentConnection, int], Awaitable[None]], number: int
    ) -> None:
        while time.perf_counter() < self.until:
            line = PersistentConnection(self.plan.url)
            try:
                await hand(line, number)
            except (OSError, EOFError) as error:
                self.seen.complaints[f"{kind}: {type(error).__name__}: {error}"] += 1
                await asyncio.sleep(1)
            finally:
                line.close()

    async def _due(self, moment: float) -> float:
        with suppress(ValueError):
            await asyncio.sleep(max(0.0, moment - time.perf_counter()))
        return moment

    # Robots

    async def _robot(self, line: PersistentConnection, number: int) -> None:
        plan, began = self.plan, time.perf_counter()
        for turn in count():
            due = time.perf_counter()
            if plan.rate:
                due = await self._due(began + (turn + number / plan.robots) / plan.rate)
            if max(due, time.perf_counter()) >= self.until:
                if plan.rate:
                    self.unsent += round(max(0.0, self.until - due) * plan.rate)
                return
            choice = (turn * 7 + number * 13) % (len(plan.scenes) + len(plan.strangers))
            if choice < len(plan.scenes):
                await self._ask(line, due, choice, plan.scenes[choice].seen)
            else:
                await self._ask(line, due, None, plan.strangers[choice - len(plan.scenes)])

    async def _ask(self, line: PersistentConnection, due: float, scene: int | None, data: bytes) -> None:
        sent = time.perf_counter()
        wanted = None if scene is None else self.of_scene.get(scene)
        status, body = await line.request("POST", f"{self._root}/query?k=5", data)
        if not self.seen.note("query", due, status, (200,), body):
            return
        answer, now = json.loads(body), time.perf_counter()
        matches = [match["place"]["id"] for match in answer["matches"]]
        self.seen.verdicts[("stranger " if scene is None else "place ") + answer["verdict"]] += 1
        for found in matches:
            if found not in self.places:
                self.seen.complaints[f"query: {found} was never enrolled"] += 1
            elif self.places[found].gone < sent:
                self.seen.complaints["query: a place came back after its deletion"] += 1
        if wanted is not None and self.places[wanted].since < sent and now < self.places[wanted].leaving:
            self.seen.verdicts["known places"] += 1
            if matches[:1] != [wanted]:
                self.seen.complaints["query: an enrolled place is not the best match of its scene"] += 1

    # Operators

    async def _operator(self, line: PersistentConnection, number: int) -> None:
        size = 1 if number % 2 == 0 else BATCH  # one place after the other, or in forms
        began = time.perf_counter()
        for turn in count(1):
            due = await self._due(began + turn * size / self.plan.enrol_rate)
            while len(self._free) < size and time.perf_counter() < self.until:
                await asyncio.sleep(0.05)  # the one who deletes is behind
            if max(due, time.perf_counter()) >= self.until:
                return
            await (self._enrol_one(line, number, due) if size == 1 else self._enrol_many(line, number, size, due))

    def _next_place(self, number: int) -> tuple[str, str]:
        traverses = self._traverses[number]
        if not traverses or len(traverses[-1].places) == PLACES_OF_A_TRAVERSE:
            index = 0 if not traverses else traverses[-1].index + 1
            traverses.append(EnrolledTraverse(f"operator-{number}-{index}", index))
        place = f"o{number}-{next(self._serial):07d}"
        self.places[place] = PlaceHistory(self._free.popleft())
        traverses[-1].places.append(place)
        return place, traverses[-1].name

    def _scene_of(self, place: str) -> bytes:
        data = self.plan.scenes[self.places[place].scene].enrolled
        # A comment behind the first marker makes it another file each time.
        return data[:2] + b"\xff\xfe" + (2 + len(place)).to_bytes(2) + place.encode() + data[2:]

    def _is_in(self, place: str) -> None:
        self.places[place].since = time.perf_counter()
        self.of_scene[self.places[place].scene] = place

    async def _enrol_one(self, line: PersistentConnection, number: int, due: float) -> None:
        place, sequence = self._next_place(number)
        status, body = await line.request(
            "PUT", f"{self._root}/places/{place}?sequence={sequence}", self._scene_of(place)
        )
        if self.seen.note("enrol one", due, status, (201,), body):
            self._is_in(place)

    async def _enrol_many(self, line: PersistentConnection, number: int, size: int, due: float) -> None:
        new = [self._next_place(number) for _ in range(size)]
        entries = [{"id": place, "file": place, "sequence": sequence} for place, sequence in new]
        parts = [_part("places", "application/json", json.dumps(entries).encode())]
        parts += [_part(place, "image/jpeg", self._scene_of(place), place) for place, _ in new]
        form = b"".join(parts) + b"--fleet--\r\n"
        kind = "multipart/form-data; boundary=fleet"
        status, body = await line.request("POST", f"{self._root}/places", form, kind)
        if not self.seen.note(f"enrol {size}", due, status, (200,), body):
            return
        for item in json.loads(body)["items"]:
            if item["status"] == 201:
                self._is_in(item["id"])
            else:
                self.seen.complaints[f"enrol {size}: an item answered {item}"] += 1

    # The one who deletes

    async def _deleter(self, line: PersistentConnection, _number: int) -> None:
        while time.perf_counter() < self.until:
            old = [traverses for traverses in self._traverses.values() if len(traverses) > RETAINED_TRAVERSES]
            if not old:
                await asyncio.sleep(0.2)
            for traverses in old:
                oldest = traverses.pop(0)
                if oldest.index % 2:
                    await self._delete(line, f"sequences/{oldest.name}", "delete traverse", oldest.places)
                else:
                    for place in oldest.places:
                        await self._delete(line, f"places/{place}", "delete place", [place])
                        await asyncio.sleep(0.1 if len(traverses) <= RETAINED_TRAVERSES else 0)

    async def _delete(self, line: PersistentConnection, path: str, kind: str, places: list[str]) -> None:
        due = time.perf_counter()
        known = [self.places[place] for place in places if self.places[place].since < NEVER]
        for one in known:
            one.leaving = due
        status, body = await line.request("DELETE", f"{self._root}/{path}")
        if self.seen.note(kind, due, status, (200, 204), body):
            for one in known:
                one.gone = time.perf_counter()
                self._free.append(one.scene)

    # Housekeeping

    async def _keeper(self, line: PersistentConnection, exports: int) -> None:
        """Looks after the map, and asks for some errors."""
        chores = [
            ("list", "GET", "places?limit=500", b"", (200,)),
            ("read", "GET", "", b"", (200,)),
            ("verify", "POST", "verify", b"", (200,)),
            ("no image", "POST", "query", b"\xff\xd8 no image", (415, 422)),
            ("no place", "GET", "places/nobody", b"", (404,)),
            ("no place to delete", "DELETE", "places/nobody", b"", (404,)),
        ]
        chores += [("export", "GET", "export", b"", (200,))] * exports
        for turn in count(1):
            due = await self._due(time.perf_counter() + HOUSEKEEPING_SECONDS)
            if due >= self.until:
                return
            name, method, path, data, expected = chores[turn % len(chores)]
            where = f"{self._root}/{path}".rstrip("/")
            status, body = await line.request(method, where, data, keep=name != "export")
            if self.seen.note(name, due, status, expected, body) and name == "verify" and not json.loads(body)["ok"]:
                self.seen.complaints[f"verify: {body[:300].decode()}"] += 1


def _part(name: str, kind: str, content: bytes, filename: str | None = None) -> bytes:
    file = "" if filename is None else f'; filename="{filename}"'
    head = f'--fleet\r\nContent-Disposition: form-data; name="{name}"{file}\r\nContent-Type: {kind}\r\n\r\n'
    return head.encode() + content + b"\r\n"
