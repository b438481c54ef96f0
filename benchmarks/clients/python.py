"""Robots that use the Python client beside those of the load tool, which only count bytes; and the time of an import.

    python -m benchmarks.clients.python

Sixteen clients in one asyncio process reach at least 0.95 times the answers a second of the load tool; importing the
client takes less than 0.3 seconds.  Both kinds of robots send the same frames to the same service, turn by turn;
medians over the turns, and the median of the turns' ratios, are shown.  Both cost something on the cores that the
service computes on.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.frames import camera_frames
from benchmarks.process import median, service
from benchmarks.report import report, verdict
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from service.commands.load import measure
from service.commands.timing.samples import fill_map

MAP = "benchmark"
ROBOTS_PROGRAM = Path(__file__).parent / "robots.py"
RATIO_LIMIT, IMPORT_LIMIT = 0.95, 0.3
IMPORTS = {"placerec_client": "import placerec_client", "Client": "from placerec_client import Client"}
IMPORTS |= {
    "AsyncClient": "from placerec_client import AsyncClient",
    "httpx and pydantic": "import httpx, pydantic.main",
}
RUNS = 9


def client_robots(url: str, frames: Path, robots: int, seconds: float, verify: str) -> dict[str, Any]:
    """The measurement of robots that use the client, in a process of their own."""
    words = {"url": url, "map": MAP, "frames": frames, "robots": robots, "seconds": seconds, "verify": verify}
    command: list[str] = [sys.executable, str(ROBOTS_PROGRAM), *(f"--{name}={value}" for name, value in words.items())]
    found: dict[str, Any] = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    return found


def import_seconds(statement: str) -> float:
    """Median seconds of a statement in a new interpreter, without those that the interpreter itself takes to start."""
    program = f"import time; began = time.perf_counter(); {statement}; print(time.perf_counter() - began)"
    taken = []
    for _ in range(RUNS):
        done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
        taken.append(float(done.stdout))
    return median(taken)


def figures_of(turns: list[dict[str, Any]]) -> dict[str, float]:
    """Medians over the turns of one kind of robots."""
    times = [np.array(turn["milliseconds"]) for turn in turns]
    rates = [len(one) / turn["seconds"] for one, turn in zip(times, turns, strict=True)]
    costs = [1e3 * turn["processor_seconds"] / len(one) for one, turn in zip(times, turns, strict=True)]
    percentiles = {f"p{p}": median([float(np.percentile(one, p)) for one in times]) for p in (50, 95, 99)}
    return {"per_second": median(rates), **percentiles, "robots_milliseconds": median(costs)}


def main(
    encoder: str = DEFAULT_ENCODER,
    places: Annotated[int, typer.Option(min=2)] = 1622,
    robots: Annotated[int, typer.Option(min=1)] = 16,
    rounds: Annotated[int, typer.Option(min=1, help="Turns of each kind.")] = 7,
    seconds: Annotated[float, typer.Option(min=0.5, help="Of one turn.")] = 5.0,
    verify: Annotated[str, typer.Option(help="auto, always or never.")] = "auto",
) -> None:
    """Take turns and compare."""
    frames, content = camera_frames(32)
    turns: dict[str, list[dict[str, Any]]] = {"load tool": [], "client": []}
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        fill_map(folder / "data", MAP, EncoderCatalogue().get(encoder), places)
        (folder / "frames").mkdir()
        for index, data in enumerate(frames):
            (folder / "frames" / f"{index:03d}.jpg").write_bytes(data)
        with service(folder / "data", settings={"QUEUE_LENGTH": 2 * robots}) as process:
            url = str(process.client.base_url)
            path = f"/v1/maps/{MAP}/query?verify={verify}"
            for turn in range(rounds + 1):  # the first one warms up
                kinds = list(turns) if turn % 2 else list(reversed(turns))
                for kind in kinds:
                    time.sleep(0.2)
                    spent = seconds if turn else 1.0
                    if kind == "client":
                        found = client_robots(url, folder / "frames", robots, spent, verify)
                    else:
                        found = measure(url, path, folder / "frames", robots, spent)
                    if turn:
                        turns[kind].append(found)
    figures = {kind: figures_of(found) for kind, found in turns.items()}
    rates = {kind: [len(one["milliseconds"]) / one["seconds"] for one in found] for kind, found in turns.items()}
    ratio = median([ours / theirs for ours, theirs in zip(rates["client"], rates["load tool"], strict=True)])
    imports = {name: import_seconds(statement) for name, statement in IMPORTS.items()}
    rows = [(kind, *found.values()) for kind, found in figures.items()]
    columns = [f"{robots} robots", "per s", "p50 ms", "p95 ms", "p99 ms", "robots' ms per query"]
    title = f"{encoder}, {places} places, {content}, verify={verify}"
    stored = {"robots": robots, "rounds": rounds, "seconds": seconds, "verify": verify, "places": places}
    report(
        "client", title, columns, rows, {**stored, "kinds": figures, "rates": rates, "ratio": ratio, "imports": imports}
    )
    print(f"client to load tool: {ratio:.3f}, {verdict(ratio, RATIO_LIMIT, at_least=True)}")
    for name, taken in imports.items():
        print(f"import of {name}: {taken:.3f} s")
    slowest = max(taken for name, taken in imports.items() if name != "httpx and pydantic")
    print(f"slowest import: {verdict(slowest, IMPORT_LIMIT)}")


if __name__ == "__main__":
    typer.run(main)
