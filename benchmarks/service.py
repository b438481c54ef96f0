"""Queries over HTTP by 1, 4, 16 and 64 robots, beside the same work done in this process.

    python -m benchmarks.service

One robot: the time of a query against encoding and searching here, at most 1.2 times.  Many robots: queries a second
against encoding in batches here, at least 85 % with 16 of them, none lost, and p99 at most 3 times p50.

Nothing is verified, there or here; ``benchmarks.geometry.requests`` measures what that costs.

The service, the robots (``service.commands.load``) and this process take turns on the same cores, several times each;
medians over the turns are shown.  The robots' own cost counts against the service: on two cores it is shown.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.frames import camera_frames
from benchmarks.process import median, service
from benchmarks.report import report, verdict
from core.frames.images import decode
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.recognition.question import Query
from core.recognition.recognition import locate
from core.store import Directory, Map
from core.threads import allowed_threads, cores, share_cores
from service.commands.load import measure
from service.commands.timing.samples import fill_map
from service.commands.timing.stages import encode_batch
from service.malloc import configure_malloc

MAP = "benchmark"
PATH = f"/v1/maps/{MAP}/query?verify=never"
BATCH = 16
QUERY_LIMIT, THROUGHPUT_LIMIT, TAIL_LIMIT = 1.2, 0.85, 3.0
SETTLE = 0.2
"""Seconds between two turns: threads of the one before stop spinning."""


def encode_and_search(encoder: Encoder, map_: Map, frames: list[bytes], seconds: float) -> list[float]:
    """One frame after the other, as one robot asks for it; milliseconds of each."""
    times: list[float] = []
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        began = time.perf_counter()
        encoding = encoder.encode(decode(frames[len(times) % len(frames)]))
        locate(map_, encoder, [Query(encoding)])
        times.append(1e3 * (time.perf_counter() - began))
    return times


def encode_in_batches(encoder: Encoder, frames: list[bytes], seconds: float) -> float:
    """Frames a second that are decoded and encoded here in batches of 16, every core at work."""
    done = 0
    began = time.perf_counter()
    while time.perf_counter() - began < seconds:
        batch = [frames[(done + index) % len(frames)] for index in range(BATCH)]
        encode_batch(encoder, batch)
        done += BATCH
    return done / (time.perf_counter() - began)


def summary(turns: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over the turns of one number of robots."""
    times = [np.array(turn["milliseconds"]) for turn in turns]
    statuses: dict[str, int] = defaultdict(int)
    for turn in turns:
        for status, count in turn["statuses"].items():
            statuses[status] += count
    percentiles = {f"p{p}": median([float(np.percentile(one, p)) for one in times]) for p in (50, 95, 99)}
    return {
        "queries": sum(map(len, times)),
        "queries_per_second": median([len(one) / turn["seconds"] for one, turn in zip(times, turns, strict=True)]),
        "statuses": dict(statuses),
        **percentiles,
        "robots_milliseconds_per_query": median(
            [1e3 * turn["processor_seconds"] / len(one) for one, turn in zip(times, turns, strict=True)]
        ),
    }


def main(
    encoder: str = DEFAULT_ENCODER,
    places: Annotated[int, typer.Option(min=2)] = 1622,
    robots: Annotated[list[int] | None, typer.Option(help="Several times; default 1, 4, 16, 64.")] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Turns of each.")] = 5,
    seconds: Annotated[float, typer.Option(min=0.5, help="Of one turn.")] = 4.0,
    threads: Annotated[int, typer.Option(min=0, help="Of a forward pass, there and here; 0: torch's choice.")] = 0,
) -> None:
    """Take turns and compare."""
    configure_malloc()  # as the service does
    share_cores(threads or allowed_threads())
    chosen = EncoderCatalogue().get(encoder)
    frames, content = camera_frames(64)
    numbers = robots or [1, 4, 16, 64]
    turns: dict[int, list[dict[str, Any]]] = defaultdict(list)
    alone: list[float] = []
    batched: list[float] = []
    count = cores()
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        fill_map(folder / "data", MAP, chosen, places)
        shutil.copytree(folder / "data", folder / "copy")  # the service holds its own alone
        (folder / "frames").mkdir()
        for index, data in enumerate(frames):
            (folder / "frames" / f"{index:03d}.jpg").write_bytes(data)
        atlas = Directory(folder / "copy")
        map_ = atlas.get(MAP)
        queue = {"QUEUE_LENGTH": 2 * max(numbers)}
        with service(folder / "data", threads, queue) as process:
            url = str(process.client.base_url)
            for turn in range(rounds + 1):  # the first one warms up
                spent = 1.0 if turn == 0 else seconds
                time.sleep(SETTLE)
                ones = encode_and_search(chosen, map_, frames, spent)
                time.sleep(SETTLE)
                rate = encode_in_batches(chosen, frames, spent)
                found = {}
                for number in numbers:
                    time.sleep(SETTLE)
                    found[number] = measure(url, PATH, folder / "frames", number, spent)
                if turn:
                    alone.append(median(ones))
                    batched.append(rate)
                    for number, seen in found.items():
                        turns[number].append(seen)
            memory = process.peak_memory()
        atlas.close()

    here, limit = median(alone), median(batched)
    rows: list[tuple[object, ...]] = [
        ("here: encode, search", f"{1e3 / here:.1f}", here, "", "", "", ""),
        (f"here: batches of {BATCH}", f"{limit:.1f}", "", "", "", "", ""),
    ]
    bars: list[str] = []
    figures: dict[str, Any] = {}
    for number in numbers:
        seen = summary(turns[number])
        lost = {status: count for status, count in seen["statuses"].items() if status != "200"}
        seen |= {
            "query_ratio": seen["p50"] / here,
            "throughput_ratio": seen["queries_per_second"] / limit,
            "tail_ratio": seen["p99"] / seen["p50"],
            "not_answered": lost,
        }
        figures[str(number)] = seen
        if number == 1:
            bars.append(
                f"1 robot: p50 {seen['query_ratio']:.2f} of one here, {verdict(seen['query_ratio'], QUERY_LIMIT)}"
            )
        if number == 16:
            share = f"{seen['throughput_ratio']:.2f} of batches here"
            bars.append(f"16 robots: {share}, {verdict(seen['throughput_ratio'], THROUGHPUT_LIMIT, at_least=True)}")
            bars.append(f"16 robots: p99 {seen['tail_ratio']:.2f} of p50, {verdict(seen['tail_ratio'], TAIL_LIMIT)}")
        rows.append(
            (
                f"{number} robots",
                f"{seen['queries_per_second']:.1f}",
                seen["p50"],
                seen["p95"],
                seen["p99"],
                f"{100 * seen['throughput_ratio']:.0f} %",
                sum(lost.values()),
            )
        )
    columns = ["", "per s", "p50 ms", "p95 ms", "p99 ms", "of batches", "refused"]
    title = f"{chosen.name}, {places} places, {content}, {count} cores"
    one = {"encode_and_search_milliseconds": here, "batched_frames_per_second": limit, "batch": BATCH}
    report(
        "service",
        title,
        columns,
        rows,
        {
            "encoder": chosen.identity,
            "places": places,
            "frames": content,
            "rounds": rounds,
            "seconds": seconds,
            "in_process": one,
            "robots": figures,
            "peak_megabytes": memory,
        },
    )
    cost = figures[str(numbers[-1])]["robots_milliseconds_per_query"]
    for bar in bars:
        print(bar)
    print(f"the robots themselves took {cost:.2f} ms of a core for each query")


if __name__ == "__main__":
    typer.run(main)
