"""Queries a second of one front with 1, 2, 4 and 8 replicas that wait as long as a device would compute.

    python -m benchmarks.ray_serve.scaling

The replicas take no processor time for a frame, so a machine of two cores can stand for one front and eight devices.
Each is one device that computes one frame after the other; the front, Ray, the robots and the replicas' handling of
calls share the cores of this machine.  At least 90 % of as many times one replica's rate, up to the limit of the
machine: that is measured with replicas that do not wait at all.  The processor time of the front alone says how many
queries a second a front with a core of its own could carry, for it has one interpreter.
"""

from __future__ import annotations

import os
import resource
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.frames import camera_frames
from benchmarks.process import median, processor_time, service, total_processor_time
from benchmarks.ray_serve.waiting import WAIT, WaitingReplica, prepare
from benchmarks.report import report, verdict
from core.frames.images import Limits
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from service.commands.load import measure
from service.commands.timing.samples import fill_map
from service.ray_serve.cluster import APPLICATION, Cluster
from service.ray_serve.encoders import WATCH
from service.settings import Settings

MAP = "benchmark"
PATH = f"/v1/maps/{MAP}/query?verify=never"
LINEAR = 0.9
NEAR = 0.9
"""A rate above this share of the limit is not the replicas'."""
WARM_SECONDS = 2.0
START_SECONDS = 300.0


def time_of_all() -> float:
    """Processor time of the front, Ray, the replicas and the robots so far, in seconds."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return total_processor_time(os.getpid()) + ended.ru_utime + ended.ru_stime


def cluster_of(folder: Path, replicas: int, batch: int) -> Cluster:
    """A cluster in which ``replicas`` replicas are deployed."""
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
    """Deploy waiting replicas in place of others, and wait until only the new ones run."""
    from ray import serve

    if cluster.state().running:
        serve.delete(APPLICATION)  # a rollout would start one after the other
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
    seconds: Annotated[float, typer.Option(min=1, help="Of one turn.")] = 4.0,
    turns: Annotated[int, typer.Option(min=1)] = 3,
) -> None:
    """Measure and compare."""
    numbers = replicas or [1, 2, 4, 8]
    frames, content = camera_frames(32)
    rates: dict[int, float] = {}
    costs: dict[int, float] = {}
    whole: dict[int, float] = {}
    refused = 0
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        fill_map(folder / "data", MAP, EncoderCatalogue().get(DEFAULT_ENCODER), places)
        (folder / "frames").mkdir()
        for index, data in enumerate(frames):
            (folder / "frames" / f"{index:03d}.jpg").write_bytes(data)
        prepare(folder / "models", DEFAULT_ENCODER, wait)
        first = cluster_of(folder, max(numbers), batch)
        first.join()
        try:
            own = {"RAY": "true", "RAY_ADDRESS": first.address(), "RAY_BATCH": batch, "QUEUE_LENGTH": 1000}
            deploy(cluster_of(folder, numbers[0], batch), numbers[0])
            with service(folder / "data", 0, own) as process:
                for number in [*numbers, 0]:
                    count = number or numbers[-1]
                    if not number:  # the limit of the machine, with those that are there
                        (folder / "models" / WAIT).write_text("0")
                    elif number != numbers[0]:
                        deploy(cluster_of(folder, count, batch), count)
                    time.sleep(2 * WATCH)  # then the front knows, too
                    robots = (2 * batch + 1) * count
                    found: list[dict[str, Any]] = []
                    for turn in range(turns + 1):  # the first one warms up
                        before = processor_time(process.pid), time_of_all()
                        lasting = seconds if turn else WARM_SECONDS
                        seen = measure(str(process.client.base_url), PATH, folder / "frames", robots, lasting)
                        seen["front"], seen["all"] = processor_time(process.pid) - before[0], time_of_all() - before[1]
                        if turn:
                            found.append(seen)
                            refused += sum(n for status, n in seen["statuses"].items() if status != "200")
                    rates[number] = median([len(one["milliseconds"]) / one["seconds"] for one in found])
                    costs[number], whole[number] = (
                        median([1e3 * one[part] / len(one["milliseconds"]) for one in found])
                        for part in ("front", "all")
                    )
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
        figures[str(number)] = {
            "queries_per_second": rate,
            "of_linear": share,
            "front_milliseconds": costs[number],
            "all_milliseconds": whole[number],
        }
        rows.append((number, f"{ideal:.1f}", f"{rate:.1f}", f"{100 * share:.0f} %", costs[number], whole[number]))
        if ideal <= NEAR * limit:
            bars.append(f"{number} replicas: {share:.2f} of linear, {verdict(share, LINEAR, at_least=True)}")
        else:
            bars.append(f"{number} replicas: {ideal:.0f}/s would be above the machine's limit ({bound:.2f} of it)")
    rows.append(("none waits", "", f"{limit:.1f}", "the machine's limit", costs[0], whole[0]))
    title = f"replicas that wait {wait:g} ms a frame in place of a device, {places} places, {content}"
    report(
        "ray_serve_scaling",
        title,
        ["replicas", "linear per s", "per s", "of linear", "ms of the front a query", "and of all processes"],
        rows,
        {
            "wait_milliseconds": wait,
            "batch": batch,
            "places": places,
            "machine_limit_per_second": limit,
            "front_limit_per_second": 1e3 / costs[0],
            "replicas": figures,
            "refused": refused,
        },
    )
    for bar in bars:
        print(bar)
    print(f"a front with a core of its own: {1e3 / costs[0]:.0f} queries/s by its processor time")
    print(f"refused: {refused}")


if __name__ == "__main__":
    typer.run(main)
