"""Queries a second of one front with 1, 2, 4 and 8 replicas that wait as long as a device would compute.

    python -m benchmarks.ray_serve.scaling

The replicas take no processor time for a frame, so a machine of two cores can stand for one front and eight devices.
Each is one device that computes one frame after the other; the front, Ray, the robots and the replicas' handling of
calls share the cores of this machine.  At least 90 % of as many times one replica's rate, up to the front's own limit:
that is measured with replicas that do not wait at all.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.frames import camera_frames
from benchmarks.process import median, processor_time, service
from benchmarks.ray_serve.waiting import WAIT, WaitingReplica
from benchmarks.report import report, verdict
from core.evaluation.samples import fill_map
from core.frames.images import Limits
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from service.commands.load import measure
from service.ray_serve.cluster import Cluster
from service.ray_serve.encoders import WATCH
from service.settings import Settings

MAP = "benchmark"
PATH = f"/v1/maps/{MAP}/query?verify=never"
LINEAR = 0.9
NEAR = 0.9
"""A rate above this share of the front's limit is the front's, not the replicas'."""
START_SECONDS = 300.0


def cluster_of(folder: Path, replicas: int, batch: int) -> Cluster:
    """A cluster in which so many replicas are deployed."""
    settings = Settings(
        data_dir=folder / "data",
        ray=True,
        ray_replicas=replicas,
        ray_max_replicas=replicas,
        ray_replica_cpus=0.1,
        ray_batch=batch,
        threads=1,
    )
    return Cluster(settings, Limits())


def deploy(cluster: Cluster, replicas: int) -> None:
    """Deploy waiting replicas, and wait until so many run and no other does."""
    cluster.deploy(WaitingReplica)
    until = time.monotonic() + START_SECONDS
    while (state := cluster.state()).running != replicas or state.deploying:
        if time.monotonic() > until:
            raise RuntimeError(f"{state.running} of {replicas} replicas run: {state.problem}")
        time.sleep(0.5)


def main(
    wait: Annotated[float, typer.Option(help="Milliseconds of a frame at a replica.")] = 80.0,
    replicas: Annotated[list[int] | None, typer.Option(help="Several times; default 1, 2, 4, 8.")] = None,
    places: Annotated[int, typer.Option(min=2)] = 200,
    batch: Annotated[int, typer.Option(min=1, help="Most frames of a call.")] = 4,
    seconds: Annotated[float, typer.Option(min=1, help="Of one turn.")] = 6.0,
    turns: Annotated[int, typer.Option(min=1)] = 3,
) -> None:
    """Measure and compare."""
    numbers = replicas or [1, 2, 4, 8]
    frames, content = camera_frames(32)
    rates: dict[int, float] = {}
    costs: dict[int, float] = {}
    refused = 0
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        fill_map(folder / "data", MAP, EncoderCatalogue().get(DEFAULT_ENCODER), places)
        (folder / "frames").mkdir()
        for index, data in enumerate(frames):
            (folder / "frames" / f"{index:03d}.jpg").write_bytes(data)
        (folder / "models").mkdir()
        (folder / "models" / WAIT).write_text(str(wait))
        first = cluster_of(folder, max(numbers), batch)
        first.join()
        try:
            own = {"RAY": "true", "RAY_ADDRESS": first.address(), "RAY_BATCH": batch, "QUEUE_LENGTH": 1000}
            deploy(cluster_of(folder, numbers[0], batch), numbers[0])
            with service(folder / "data", 0, own) as process:
                for number in [*numbers, 0]:
                    if not number:  # the front's own limit, with as many as it may need
                        (folder / "models" / WAIT).write_text("0")
                    count = number or 2
                    deploy(cluster_of(folder, count, batch), count)
                    time.sleep(2 * WATCH)  # then the front knows, too
                    robots = (2 * batch + 1) * count
                    found: list[dict[str, Any]] = []
                    for turn in range(turns + 1):  # the first one warms up
                        before = processor_time(process.pid)
                        seen = measure(str(process.client.base_url), PATH, folder / "frames", robots, seconds)
                        seen["front"] = processor_time(process.pid) - before
                        if turn:
                            found.append(seen)
                            refused += sum(n for status, n in seen["statuses"].items() if status != "200")
                    rates[number] = median([len(one["milliseconds"]) / one["seconds"] for one in found])
                    costs[number] = median([1e3 * one["front"] / len(one["milliseconds"]) for one in found])
        finally:
            first.close()
    limit = rates.pop(0)
    rows: list[tuple[object, ...]] = []
    bars: list[str] = []
    figures: dict[str, Any] = {}
    for number, rate in rates.items():
        ideal = number * 1e3 / wait
        share = rate / ideal
        bound = min(1.0, limit / ideal)
        figures[str(number)] = {"queries_per_second": rate, "of_linear": share, "front_milliseconds": costs[number]}
        rows.append((number, f"{ideal:.1f}", f"{rate:.1f}", f"{100 * share:.0f} %", costs[number]))
        if ideal <= NEAR * limit:
            bars.append(f"{number} replicas: {share:.2f} of linear, {verdict(share, LINEAR, at_least=True)}")
        else:
            bars.append(f"{number} replicas: {ideal:.0f}/s would be above the front's limit ({bound:.2f} of it)")
    rows.append(("none waits", "", f"{limit:.1f}", "the front's limit", costs[0]))
    title = f"replicas that wait {wait:g} ms a frame in place of a device, {places} places, {content}"
    report(
        "ray_serve_scaling",
        title,
        ["replicas", "linear per s", "per s", "of linear", "ms of the front a query"],
        rows,
        {
            "wait_milliseconds": wait,
            "batch": batch,
            "places": places,
            "front_limit_per_second": limit,
            "replicas": figures,
            "refused": refused,
        },
    )
    for bar in bars:
        print(bar)
    print(f"refused: {refused}")


if __name__ == "__main__":
    typer.run(main)
