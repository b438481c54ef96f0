"""The cost of Ray for a query: a service whose encoders are in a Ray cluster beside one that encodes itself, both real.

    python -m benchmarks.ray_serve.overhead

Both run at the same time on data of their own and the same cores, and take turns at the load.  The encoders have as
many threads there as here.  Processor time is that of the service with all processes that it has started, which are
Ray's, without the robots: it is the cost where the cores are the limit, and a busy machine changes it little.  At most
25 % more a query with the robots of the last number.
"""

from __future__ import annotations

import shutil
import tempfile
from collections import defaultdict
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.frames import camera_frames
from benchmarks.process import median, service, total_processor_time
from benchmarks.report import report, verdict
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.threads import cores
from service.commands.load import measure
from service.commands.timing.samples import fill_map

MAP = "benchmark"
PATH = f"/v1/maps/{MAP}/query?verify=never"
LIMIT = 1.25


def main(
    encoder: str = DEFAULT_ENCODER,
    places: Annotated[int, typer.Option(min=2)] = 1622,
    robots: Annotated[list[int] | None, typer.Option(help="Several times; default 1, 4, 16.")] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Turns of each.")] = 5,
    seconds: Annotated[float, typer.Option(min=0.5, help="Of one turn.")] = 4.0,
    replicas: Annotated[int, typer.Option(min=1, help="They share the cores.")] = 1,
    batch: Annotated[int, typer.Option(min=1, help="Most frames of a call.")] = 8,
) -> None:
    """Take turns and compare."""
    numbers = robots or [1, 4, 16]
    frames, content = camera_frames(64)
    seen: dict[tuple[str, int], list[dict[str, float]]] = defaultdict(list)
    lost = 0
    ray = {
        "RAY": "true",
        "RAY_REPLICAS": replicas,
        "RAY_MAX_REPLICAS": replicas,
        "RAY_REPLICA_CPUS": cores() / replicas,
        "RAY_BATCH": batch,
    }
    with tempfile.TemporaryDirectory() as text, ExitStack() as stack:
        folder = Path(text)
        chosen = EncoderCatalogue().get(encoder)
        fill_map(folder / "here", MAP, chosen, places)
        shutil.copytree(folder / "here", folder / "ray")
        (folder / "frames").mkdir()
        for index, data in enumerate(frames):
            (folder / "frames" / f"{index:03d}.jpg").write_bytes(data)
        queue = {"QUEUE_LENGTH": 4 * max(numbers)}
        services = {
            "threads": stack.enter_context(service(folder / "here", 0, queue)),
            "Ray": stack.enter_context(service(folder / "ray", 0, queue | ray)),
        }
        for turn in range(rounds + 1):  # the first one warms up
            for number in numbers:
                for name, process in services.items():
                    before = total_processor_time(process.pid)
                    found = measure(str(process.client.base_url), PATH, folder / "frames", number, seconds)
                    spent = total_processor_time(process.pid) - before
                    lost += sum(n for status, n in found["statuses"].items() if status != "200")
                    if turn:
                        count = len(found["milliseconds"])
                        seen[name, number].append(
                            {
                                "rate": count / found["seconds"],
                                "p50": float(np.median(found["milliseconds"])),
                                "cost": 1e3 * spent / count,
                            }
                        )
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {}
    for number in numbers:
        ratios = {
            key: median(
                [
                    with_ray[key] / without[key]
                    for without, with_ray in zip(seen["threads", number], seen["Ray", number], strict=True)
                ]
            )
            for key in ("rate", "p50", "cost")
        }
        medians = {
            name: {key: median([one[key] for one in seen[name, number]]) for key in ("rate", "p50", "cost")}
            for name in ("threads", "Ray")
        }
        for name, one in medians.items():
            of_threads = (f"{ratios['cost']:.2f}", f"{1 / ratios['rate']:.2f}") if name == "Ray" else ("", "")
            rows.append((f"{number} robots, {name}", f"{one['rate']:.1f}", one["p50"], one["cost"], *of_threads))
        figures[str(number)] = {**medians, "ratios": ratios}
    title = f"{encoder}, {places} places, {content}, {cores()} cores, {replicas} replicas"
    columns = ["", "per s", "p50 ms", "processor ms a query", "of threads", "time a query, of threads"]
    report(
        "ray_serve_overhead", title, columns, rows,
        {"encoder": chosen.identity, "places": places, "rounds": rounds, "replicas": replicas, "batch": batch,
         "robots": figures, "refused": lost},
    )  # fmt: skip
    last = figures[str(numbers[-1])]["ratios"]
    print(f"{numbers[-1]} robots: {1 / last['rate']:.2f} times the time a query, {verdict(1 / last['rate'], LIMIT)}")
    print(f"{numbers[-1]} robots: {last['cost']:.2f} times the processor time, {verdict(last['cost'], LIMIT)}")
    print(f"refused: {lost}")


if __name__ == "__main__":
    typer.run(main)
