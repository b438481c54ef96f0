"""How many services and cores a fleet needs over one PostgreSQL: a model of queues, held against what was measured.

    python -m benchmarks.cluster.sizing [--rate 1] [--wait 0.5]

Measured here are the processor time of a query in a service and in PostgreSQL, memory and disk of a place, and the
answers a second of robots that ask again at once, by one service and by two.  From the times alone the model foretells
these answers: cores are the servers of one queue, and each service has one interpreter, which a query holds for a part
of its time.  Then it sizes fleets whose robots ask at random moments, so that the mean wait for a core is at most
``--wait`` of the time that a query takes there.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import httpx
import psycopg
import typer

from benchmarks.checkouts import BATCH, ROOT, enrol, load, running
from benchmarks.cluster.queues import closed, servers_for
from benchmarks.frames import camera_frames
from benchmarks.process import median, memory, total_processor_time
from benchmarks.report import report, verdict
from core.threads import cores
from tests.servers.postgres import Postgres, running_postgres

INTERPRETER = 0.25
"""The share of a query's time in a service for which it holds the interpreter: sixteen cores answer 140 queries of 28
ms in a second, however many robots ask (``benchmarks.devices.served``)."""

CODES = 2_400
"""Bytes of a place in the memory of each service that searches its map (``docs/explanation/index-and-tiers.md``)."""

MOST_APART = 0.2
BUSY = 2 / 3
"""Of the time of an interpreter that a fleet may take."""

FLEETS = ((10, 10**4), (100, 10**5), (1_000, 10**5), (1_000, 10**6))
"""Robots, and places of all their maps, which each service holds."""

SETUPS = ((1, 1), (1, 4), (1, 16), (2, 4), (2, 16))
"""Services and robots."""

SETTLE = 0.3
"""Seconds between two turns."""


@dataclass(frozen=True)
class Times:
    """Seconds of a core for one query."""

    service: float
    postgres: float

    def foretold(self, services: int, robots: int, processors: int) -> float:
        """Answers a second of robots that ask again at once, on processors that services share with PostgreSQL."""
        rate, _ = closed(self.service + self.postgres, processors, robots)
        return min(rate, services / (INTERPRETER * self.service))


@dataclass(frozen=True)
class Measured:
    """Measurements of services and PostgreSQL.

    times: of a query of one of four robots.
    answers: a second, by services and robots.
    base: MB of a service before it has a map.
    disk: bytes of a place in PostgreSQL.
    """

    times: Times
    answers: dict[tuple[int, int], float]
    base: float
    disk: float


def stored_bytes(server: Postgres) -> int:
    """The size of the database."""
    with psycopg.connect(server.address) as connection:
        row = connection.execute("SELECT pg_database_size(current_database())").fetchone()
    assert row is not None
    return int(row[0])


def measured(places: int, rounds: int, seconds: float) -> Measured:
    """Enrol a map in PostgreSQL and let robots ask one service, and two."""
    frames, _ = camera_frames(48)
    references, _ = camera_frames(places, "reference")
    answers: dict[tuple[int, int], list[float]] = defaultdict(list)
    times: list[Times] = []
    with running_postgres() as server, ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        shown = folder / "frames"
        shown.mkdir()
        for index, frame in enumerate(frames):
            (shown / f"{index:03d}.jpg").write_bytes(frame)
        settings = {"PLACEREC_DATABASE": server.address}
        services = [stack.enter_context(running(ROOT, folder / f"service-{n}", settings))[:2] for n in range(2)]
        clients: list[httpx.Client] = [client for client, _ in services]
        pids = [pid for _, pid in services]
        postgres = server.server.process_id
        base, before = memory(pids[0]), stored_bytes(server)
        clients[0].post("/v1/maps", json={"id": "lab", "keep": "none"}).raise_for_status()
        for first in range(0, places, BATCH):
            enrol(clients[0], "lab", references, first, min(BATCH, places - first))
        disk = (stored_bytes(server) - before) / places
        urls = [str(client.base_url) for client in clients]
        for turn in range(rounds + 1):  # the first one warms up
            for asked, robots in SETUPS:
                time.sleep(SETTLE)
                spent = total_processor_time(pids[0]), total_processor_time(postgres)
                with ThreadPoolExecutor(asked) as pool:
                    turns = pool.map(partial(load, frames=shown, robots=robots // asked, seconds=seconds), urls[:asked])
                    seen = list(turns)
                if turn:
                    answers[asked, robots].append(sum(len(one["milliseconds"]) / one["seconds"] for one in seen))
                if turn and (asked, robots) == (1, 4):
                    count = len(seen[0]["milliseconds"])
                    service = total_processor_time(pids[0]) - spent[0]
                    stored = total_processor_time(postgres) - spent[1]
                    times.append(Times(service / count, stored / count))
    typical = Times(median([one.service for one in times]), median([one.postgres for one in times]))
    return Measured(typical, {setup: median(values) for setup, values in answers.items()}, base, disk)


def sized(robots: int, places: int, rate: float, wait: float, found: Measured) -> dict[str, Any]:
    """Services, cores, memory and disk of a fleet."""
    asked, times = robots * rate, found.times
    return {
        "robots": robots,
        "places": places,
        "services": max(2, math.ceil(asked * INTERPRETER * times.service / BUSY)),
        "service_cores": servers_for(asked, times.service, wait * times.service),
        "postgres_cores": servers_for(asked, times.postgres, wait * times.postgres),
        "gigabytes_of_a_service": found.base / 1e3 + CODES * places / 1e9,
        "gigabytes_of_postgres": found.disk * places / 1e9,
    }


def main(
    rate: Annotated[float, typer.Option(help="Queries a second of a robot.")] = 1.0,
    wait: Annotated[float, typer.Option(help="Mean wait for a core, in the time of a query there, at most.")] = 0.5,
    places: Annotated[int, typer.Option(min=100, help="Of the map that is asked, a street.")] = 400,
    rounds: Annotated[int, typer.Option(min=1, help="Turns of each number of robots.")] = 5,
    seconds: Annotated[float, typer.Option(min=1, help="Of one turn.")] = 4.0,
) -> None:
    """Measure, compare the model with what was measured, and size fleets."""
    found = measured(places, rounds, seconds)
    times, rows, worst = found.times, [], 0.0
    for (services, robots), rate_there in found.answers.items():
        foretold = times.foretold(services, robots, cores())
        error = foretold / rate_there - 1
        worst = max(worst, abs(error))
        rows.append([f"{services} services, {robots} robots", foretold, rate_there, f"{error:+.0%}"])
    spent = {"service": 1e3 * times.service, "postgres": 1e3 * times.postgres}
    title = f"answers a second on {cores()} cores; a query takes " + ", ".join(
        f"{value:.1f} ms of {name}" for name, value in spent.items()
    )
    figures = {"milliseconds": spent, "base_megabytes": found.base, "bytes_of_a_place": found.disk, "rows": rows}
    report("cluster_model", title, ["", "foretold", "measured", "error"], rows, figures)
    print(f"largest error {worst:.2f}: {verdict(worst, MOST_APART)}")
    fleets = [sized(*fleet, rate, wait, found) for fleet in FLEETS]
    columns = [
        "robots",
        "places",
        "services",
        "their cores",
        "PostgreSQL's cores",
        "GB of a service",
        "GB of PostgreSQL",
    ]
    title = f"fleets, {rate:g} queries a second of a robot"
    report("cluster_sizing", title, columns, [list(one.values()) for one in fleets], {"rate": rate, "fleets": fleets})


if __name__ == "__main__":
    typer.run(main)
