"""How many machines a fleet needs, the cost of a query, and which part gives out first: a queueing model.

    python -m benchmarks.cluster.sizing [--rate 1] [--places-per-map 100000]

Robots ask at random moments, each ``--rate`` times a second.  A query passes the front (HTTP and everything but what
follows), an encoder, Milvus and PostgreSQL; each of these is a queue with several servers (M/M/c), and has as many
servers as keep its mean wait under ``--wait`` of its own service time.  A robot asks one map, so that Milvus's time
grows with the places of a map and its memory with those of all maps; that it passes over the other maps of a partition
is not counted.

Service times come from ``measured.json`` beside this file, those of Milvus and PostgreSQL from what
``benchmarks.cluster.search`` has left in ``benchmarks/results``, if it has; prices are assumptions, options of this
command.  Milvus's is the processor time of exact search, by place.  Before it is used, the model foretells what was
measured: the embedded service with robots that each ask again when they have their answer.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.cluster.queues import closed, servers_for, waiting
from benchmarks.report import RESULTS, report

HERE = Path(__file__).parent
FLEETS = ((10, 10**6), (1000, 10**6), (1000, 10**8), (100_000, 10**8), (100_000, 10**9))
"""Robots, and places of all their maps."""

VALUES = 16_384
SINGLE, HALF = 4 * VALUES, 2 * VALUES
CODES = VALUES // 8
IN_POSTGRES = HALF + 24_000
"""Bytes of a place: its descriptor, local descriptors, thumbnail and fields."""

MACHINE_CORES, MACHINE_GB = 16, 128
SMALLEST = {"front": 2, "encoder": 4, "milvus": 2, "postgres": 2}
"""Cores of compose.cluster.yaml on a machine of its own each, for the part that is exhausted first."""


@dataclass(frozen=True)
class Times:
    """Seconds of a core for one query, by part, and the seconds of Milvus for one place searched."""

    front: float
    encoder: float
    postgres: float
    per_place: float

    def of(self, part: str, places: int) -> float:
        """Seconds of a part, in a map with ``places`` places."""
        return places * self.per_place if part == "milvus" else float(getattr(self, part))


@dataclass(frozen=True)
class IndexCost:
    """Milvus's memory of a place, in bytes, and the share of its exact time that a search takes."""

    name: str
    memory: int
    share: float


INDEXES = (
    IndexCost("exact", SINGLE, 1.0),
    IndexCost("codes", CODES, 1 / 16),
)
"""FLAT of float32, as measured; IVF_RABITQ with halves on disk, not tried: its time is foretold by the bytes read."""


def load_measured() -> dict[str, Any]:
    """The measurements: the file beside this one, and newer results where they are."""
    found: dict[str, Any] = json.loads((HERE / "measured.json").read_text())
    search = RESULTS / "cluster_search.json"
    if search.exists():
        stored = json.loads(search.read_text())
        row = stored["rows"][1]
        if "milvus_milliseconds" in row:
            found["stores"] = {"places": stored["places"], "milvus": row["milvus_milliseconds"]}
            found["stores"] |= {"postgres": row["postgres_milliseconds"], "source": "benchmarks/results"}
    return found


def times_of(measured: dict[str, Any]) -> Times:
    """Seconds by part."""
    core, stores = measured["core_milliseconds"], measured["stores"]
    return Times(
        front=(core["query"] - core["encode"]) / 1e3,
        encoder=core["encode"] / 1e3,
        postgres=stores["postgres"] / 1e3,
        per_place=stores["milvus"] / stores["places"] / 1e3,
    )


def foretold(measured: dict[str, Any]) -> list[list[object]]:
    """Answers a second and milliseconds, foretold and measured, of robots that ask again when they have an answer."""
    cost = measured["core_milliseconds"]["query"] / 1e3
    rows: list[list[object]] = []
    for robots, rate in measured["embedded"]["robots"].items():
        predicted, seconds = closed(cost, 2, int(robots))
        error = predicted / rate - 1
        rows.append([f"{robots} robots", predicted, rate, 1e3 * seconds, 1e3 * int(robots) / rate, f"{error:+.0%}"])
    return rows


def sized(
    robots: int, places: int, rate: float, most: int, wait: float, times: Times, index: IndexCost
) -> dict[str, Any]:
    """Servers of each part, memory and disk, and what a query takes."""
    arrivals, searched = robots * rate, min(places, most)
    parts, seconds = {}, 0.0
    for part in SMALLEST:
        service = times.of(part, searched) * (index.share if part == "milvus" else 1.0)
        servers = servers_for(arrivals, service, wait * service)
        seconds += service + waiting(arrivals, service, servers)
        parts[part] = servers
    memory = places * index.memory / 1e9
    needed = max(math.ceil(sum(parts.values()) / MACHINE_CORES), math.ceil(memory / (0.75 * MACHINE_GB)))
    return {
        "robots": robots,
        "places": places,
        "index": index.name,
        "cores": parts,
        "memory_gb": memory,
        "postgres_gb": places * IN_POSTGRES / 1e9,
        "machines": max(2, needed),
        "milliseconds": 1e3 * seconds,
        "bound_by": "memory" if memory / (0.75 * MACHINE_GB) > sum(parts.values()) / MACHINE_CORES else
        max(parts, key=lambda part: parts[part]),
    }  # fmt: skip


def first_to_give_out(times: Times, places: int, share: float) -> list[tuple[float, str]]:
    """Queries a second at which each part of the smallest cluster is full, the fewest first."""
    limits = [
        (cores / (times.of(part, places) * (share if part == "milvus" else 1.0)), part)
        for part, cores in SMALLEST.items()
        if times.of(part, places) > 0
    ]
    return sorted(limits)


def main(
    rate: Annotated[float, typer.Option(help="Queries a second of a robot.")] = 1.0,
    places_per_map: Annotated[int, typer.Option(help="The most places that a query searches.")] = 100_000,
    wait: Annotated[float, typer.Option(help="Mean wait of a part, in its service times, at most.")] = 0.5,
    machine: Annotated[float, typer.Option(help="Price of an hour of 16 cores and 128 GB, assumed.")] = 0.8,
    gigabyte: Annotated[float, typer.Option(help="Price of a GB of disk a month, assumed.")] = 0.1,
) -> None:
    """Compare the model with what was measured, and size the fleets."""
    measured = load_measured()
    times = times_of(measured)
    checked = foretold(measured)
    columns = ["embedded, two cores", "foretold, 1/s", "measured, 1/s", "foretold, ms", "measured, ms", "error"]
    report("cluster_model", "the model against what was measured", columns, checked, {"rows": checked})
    rows, stored = [], []
    for robots, places in FLEETS:
        for index in INDEXES:
            found = sized(robots, places, rate, places_per_map, wait, times, index)
            hours = 730.0
            price = found["machines"] * machine + found["postgres_gb"] * gigabyte / hours
            found["price_per_million_queries"] = price / (robots * rate * 3600) * 1e6
            stored.append(found)
            cores = "/".join(str(found["cores"][part]) for part in SMALLEST)
            rows.append(
                [f"{robots:,} robots, {places:.0e} places, {index.name}", cores, f"{found['memory_gb']:,.0f}",
                 f"{found['postgres_gb']:,.0f}", found["machines"], f"{found['milliseconds']:.0f}",
                 f"{found['price_per_million_queries']:.2f}", found["bound_by"]]
            )  # fmt: skip
    columns = [
        "fleet",
        "/".join(SMALLEST),
        "memory, GB",
        "disk, GB",
        "machines",
        "ms",
        "per 10⁶ queries",
        "most is for",
    ]
    figures = {
        "times": vars(times),
        "rate": rate,
        "places_per_map": places_per_map,
        "fleets": stored,
        "measured": measured,
    }
    report("cluster_sizing", f"cores, machines of {MACHINE_CORES} cores and {MACHINE_GB} GB", columns, rows, figures)
    for index in INDEXES:
        limits = first_to_give_out(times, places_per_map, index.share)
        limited = ", ".join(f"{part} at {limit:.0f}/s" for limit, part in limits)
        print(f"smallest cluster, {index.name}: first {limited}")


if __name__ == "__main__":
    typer.run(main)
