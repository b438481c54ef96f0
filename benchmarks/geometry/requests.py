"""The cost of verification for a whole request over HTTP: never, auto and always, in turns.

    python -m benchmarks.geometry.requests --data ../shared/datasets [--rounds 1]

Each traverse's references are enrolled as one sequence, with and without keypoints, and its queries are sent one
after the other, each in all three ways.  ``auto`` may take 1.25 times as long as ``never`` on average, ``always`` 1.8
times.  Then sixteen robots send them together, in turns: ``auto`` is to answer 0.75 of what ``never`` does, ``always``
half of it; and enrolment with keypoints is to have 0.7 of the speed without.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Annotated, Any

import httpx
import numpy as np
import typer

from benchmarks.process import service
from benchmarks.report import report, verdict
from core.frames.traverses import find_images
from service.commands.load import measure

WAYS = ("never", "auto", "always")
TRAVERSES = {"corridor": ("corridor", "query", "ref"), "lip6": ("lip6_outdoor", "query", "reference")}
TOGETHER = 32
RATIO = {"auto": 1.25, "always": 1.8}
"""Of the time of ``never``, at most."""
SHARE = {"auto": 0.75, "always": 0.5}
"""Of the answers that sixteen robots get with ``never``, at least."""
ENROLLED = 0.7
"""Of the speed without keypoints, at least."""
ROBOTS, TURNS, SECONDS = 16, 3, 4.0


def enrol(client: httpx.Client, map_id: str, folder: Path, verification: bool) -> float:
    """Enrol the frames of a folder as one sequence; frames a second."""
    client.post("/v1/maps", json={"id": map_id, "verification": verification}).raise_for_status()
    paths = find_images(folder)
    began = time.perf_counter()
    for first in range(0, len(paths), TOGETHER):
        some = paths[first : first + TOGETHER]
        files = {f"f{i}": (path.name, path.read_bytes()) for i, path in enumerate(some, first)}
        listed = [{"id": f"p{i}", "file": f"f{i}", "sequence": "reference"} for i in range(first, first + len(some))]
        data = {"places": json.dumps(listed)}
        client.post(f"/v1/maps/{map_id}/places", data=data, files=files).raise_for_status()
    return len(paths) / (time.perf_counter() - began)


def queried_ways(client: httpx.Client, map_id: str, paths: list[Path], rounds: int) -> dict[str, dict[str, Any]]:
    """For each way the milliseconds of every query as the client sees them, and what was verified."""
    times: dict[str, list[float]] = defaultdict(list)
    counts: dict[str, list[int]] = defaultdict(list)
    verdicts: dict[str, list[str]] = defaultdict(list)
    for turn in range(rounds + 1):
        for path in paths if turn else paths[:20]:  # the first ones warm up
            data = path.read_bytes()
            for way in WAYS:
                began = time.perf_counter()
                response = client.post(
                    f"/v1/maps/{map_id}/query?verify={way}", content=data, headers={"Content-Type": "image/jpeg"}
                )
                spent = 1e3 * (time.perf_counter() - began)
                answer = response.raise_for_status().json()
                if turn:
                    times[way].append(spent)
                    counts[way].append(answer["verification"]["candidates"] if answer["verification"] else 0)
                    verdicts[way].append(answer["verdict"])
    return {
        way: {
            "mean": float(np.mean(times[way])),
            "median": float(np.median(times[way])),
            "p95": float(np.percentile(times[way], 95)),
            "verified": float(np.mean(np.array(counts[way]) > 0)),
            "candidates": float(np.mean(counts[way])),
            "recognized": verdicts[way].count("recognized") / len(verdicts[way]),
        }
        for way in WAYS
    }


def together(client: httpx.Client, map_id: str, folder: Path) -> dict[str, float]:
    """For each way the answers a second that sixteen robots get; medians of turns."""
    rates: dict[str, list[float]] = defaultdict(list)
    for _ in range(TURNS):
        for way in WAYS:
            path = f"/v1/maps/{map_id}/query?verify={way}"
            seen = measure(str(client.base_url), path, folder, ROBOTS, SECONDS)
            rates[way].append(seen["statuses"].get("200", 0) / seen["seconds"])
    return {way: float(np.median(found)) for way, found in rates.items()}


def main(
    data: Annotated[Path, typer.Option(help="The folder of data sets, with eval/ in it.")],
    rounds: Annotated[int, typer.Option(min=1)] = 1,
) -> None:
    """Ask, and print the times."""
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, service(Path(folder)) as process:
        for name, (dataset, queries, references) in TRAVERSES.items():
            base = data / "eval" / dataset
            rates = {
                "without": enrol(process.client, f"{name}-bare", base / references, False),
                "with": enrol(process.client, name, base / references, True),
            }
            found = queried_ways(process.client, name, find_images(base / queries), rounds)
            many = together(process.client, name, base / queries)
            never = found["never"]
            for way, seen in found.items():
                ratio, more = seen["mean"] / never["mean"], seen["mean"] - never["mean"]
                share = many[way] / many["never"]
                bars = "" if way not in RATIO else verdict(ratio, RATIO[way])
                bars += "" if way not in SHARE else ", " + verdict(share, SHARE[way], at_least=True)
                shares = (seen["verified"], seen["candidates"], seen["recognized"], many[way], share)
                rows.append((f"{name}, {way}", seen["mean"], seen["median"], seen["p95"], ratio, more, *shares, bars))
            stored = process.client.get(f"/v1/maps/{name}").json()["storage"]["keypoints"]
            figures[name] = {"enrolled_a_second": rates, "ways": found, "together": many, "keypoints": stored}
            print(
                f"{name}: {rates['with']:.1f} frames/s enrolled with keypoints, {rates['without']:.1f} without, "
                f"{verdict(rates['with'] / rates['without'], ENROLLED, at_least=True)}; "
                f"{stored['bytes'] / stored['places'] / 1000:.1f} KB a place"
            )
    columns = ["", "mean ms", "median", "p95", "ratio", "more", "verified", "candidates", "recognized", "16: a second",
               "of never", ""]  # fmt: skip
    report("geometry_requests", "One robot, of two cores", columns, rows, figures)


if __name__ == "__main__":
    typer.run(main)
