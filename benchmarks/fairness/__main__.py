"""How one robot is served while the key of another takes all that it can get.

    python -m benchmarks.fairness --seconds 20

For each attack the service is new and has two keys.  The robot asks in a timetable, alone at first and then during the
attack; with the attacks on sessions and on streams it begins one of its own each second as well.  A refusal is any
answer that is no 2xx.  The bar for the 99th percentile is three times the median without an attack, and twice the time
of the largest frame that is permitted.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import httpx
import numpy as np
import typer

from benchmarks.fairness.attacks import ATTACKS, MAP, QUERY, large_picture
from benchmarks.fleet import PersistentConnection
from benchmarks.frames import camera_frames
from benchmarks.process import ROOT, service
from benchmarks.report import report, verdict
from service.access.keys import Keys

RATE = 8.0
"""Frames a second of the robot."""

PLACES = 64
COLUMNS = ["attack", "answered", "refused", "p50 alone", "p50", "p99", "bar"]


class TimedRobot:
    """A robot with a key of its own.

    Args:
        frames: which it asks about, JPEG files.
    """

    def __init__(self, url: str, key: str, frames: list[bytes]) -> None:
        self._url, self._frames = url, frames
        self._headers = f"Authorization: Bearer {key}\r\n"

    async def work(self, seconds: float, attack: str) -> tuple[list[float], Counter[int]]:
        """Ask for a while: the milliseconds of each answer to a query, and the statuses of all answers."""
        times: list[float] = []
        statuses: Counter[int] = Counter()
        await asyncio.gather(self._ask(seconds, times, statuses), self._begin(seconds, attack, statuses))
        return times, statuses

    async def _ask(self, seconds: float, times: list[float], statuses: Counter[int]) -> None:
        line, began = PersistentConnection(self._url, self._headers), time.perf_counter()
        for turn in range(int(seconds * RATE)):
            due = began + turn / RATE
            await asyncio.sleep(max(0.0, due - time.perf_counter()))
            sent = time.perf_counter()
            status, _ = await line.request("POST", QUERY, self._frames[turn % len(self._frames)])
            statuses[status] += 1
            times.append(1e3 * (time.perf_counter() - sent))
        line.close()

    async def _begin(self, seconds: float, attack: str, statuses: Counter[int]) -> None:
        """Begin a session or a stream each second, with the attacks on these."""
        until = time.perf_counter() + seconds
        while attack in ("sessions", "streams") and time.perf_counter() < until:
            statuses[await (self._session() if attack == "sessions" else self._stream())] += 1
            await asyncio.sleep(1)

    async def _session(self) -> int:
        line = PersistentConnection(self._url, self._headers)
        status, body = await line.request("POST", f"/v1/maps/{MAP}/sessions", b"{}", "application/json")
        if status == 201:
            path = f"/v1/maps/{MAP}/sessions/{json.loads(body)['id']}/frames"
            status, _ = await line.request("POST", path, self._frames[0])
        line.close()
        return status

    async def _stream(self) -> int:
        async with httpx.AsyncClient(base_url=self._url, timeout=60) as client:
            name, value = self._headers.strip().split(": ")
            async with client.stream("GET", f"/v1/maps/{MAP}/events", headers={name: value}) as answer:
                return answer.status_code


@contextlib.contextmanager
def attacking(url: str, key: str, name: str, found: dict[str, Any]) -> Iterator[None]:
    """An attack in a process of its own; the counts of its answers are added to ``found``."""
    command = [sys.executable, "-m", "benchmarks.fairness.attacks", url, key, name]
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        if process.stdout.readline() != "ready\n":
            raise RuntimeError(f"the attack {name} did not begin")
        yield
    finally:
        answers, _ = process.communicate()
        found["attacker"] = json.loads(answers)


def measure(name: str, seconds: float, frames: list[bytes], places: list[bytes]) -> dict[str, Any]:
    """One attack on a new service."""
    with tempfile.TemporaryDirectory() as folder:
        data_dir = Path(folder) / "data"
        keys = Keys.of(data_dir)
        _, admin = keys.create("admin", "admin")
        (_, robot), (_, greedy) = (keys.create(name, "query") for name in ("robot", "greedy"))
        with service(data_dir, log=Path(folder) / "log") as process:
            url = str(process.client.base_url).rstrip("/")
            process.client.headers["Authorization"] = f"Bearer {admin}"
            process.client.post("/v1/maps", json={"id": MAP}).raise_for_status()
            for number, frame in enumerate(places):
                process.client.put(
                    f"/v1/maps/{MAP}/places/p{number}", content=frame, headers={"Content-Type": "image/jpeg"}
                ).raise_for_status()
            asker = TimedRobot(url, robot, frames)
            asyncio.run(asker.work(3, ""))  # a warm-up
            alone, _ = asyncio.run(asker.work(seconds / 2, ""))
            largest = _largest(process.client)
            found: dict[str, Any] = {"alone": float(np.median(alone)), "largest": largest}
            with attacking(url, greedy, name, found):
                times, statuses = asyncio.run(asker.work(seconds, name))
        return found | {
            "bar": 3 * found["alone"] + 2 * largest,
            "median": float(np.median(times)),
            "p99": float(np.percentile(times, 99)),
            "longest": max(times),
            "answered": sum(count for status, count in statuses.items() if status < 300),
            "refused": sum(count for status, count in statuses.items() if status >= 300),
            "statuses": {str(status): count for status, count in statuses.items()},
        }


def _largest(client: httpx.Client) -> float:
    """Milliseconds of a query with the largest frame, alone; the median of three."""
    picture, times = large_picture(), []
    for _ in range(3):
        began = time.perf_counter()
        client.post(QUERY, content=picture, headers={"Content-Type": "image/jpeg"}).raise_for_status()
        times.append(1e3 * (time.perf_counter() - began))
    return float(np.median(times))


def main(
    attacks: Annotated[list[str] | None, typer.Argument(help=f"Of {', '.join(ATTACKS)}; all by default.")] = None,
    seconds: Annotated[float, typer.Option(help="How long each attack lasts.")] = 20.0,
) -> None:
    """Measure a robot alone and during each attack."""
    frames, content = camera_frames(16)
    places, _ = camera_frames(PLACES, "reference")
    found: dict[str, Any] = {}
    rows = []
    for name in attacks or ATTACKS:
        one = found[name] = measure(name, seconds, frames, places)
        met = verdict(one["p99"], one["bar"])
        rows.append((name, one["answered"], one["refused"], one["alone"], one["median"], one["p99"], met))
    title = f"One robot, {content}, {RATE:g} a second, and another key that attacks; milliseconds"
    report("fairness", title, COLUMNS, rows, {"attacks": found})


if __name__ == "__main__":
    typer.run(main)
