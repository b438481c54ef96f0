"""The cost of a query with two encoders: that of the thesis beside the default.

    python -m benchmarks.devices.encoders [--encoder NAME] [--encoder NAME] [--places 300] [--rounds 60]

In this process a frame is encoded and the second stage compares it with the places of a map, in turn with either
encoder; medians of processor time.  Then one service has both maps, and one robot asks for either in turn, ``BLOCK``
queries at a time: medians of the time until an answer, and the service's processor time for each query.
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
from benchmarks.process import Process, median, service
from benchmarks.report import report, verdict
from core.frames.images import decode
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.recognition.stages import agree
from core.store import Directory, Map
from core.threads import share_cores
from service.commands.timing.samples import write_map
from service.malloc import configure_malloc

LIMIT = 1.1
TOGETHER, ANSWER, SERVED = "both together", "query over HTTP, until the answer", "query over HTTP, processor time"
JUDGED = (TOGETHER, ANSWER, SERVED)
BLOCK = 10
WARM_UP = 5

Times = dict[str, list[list[float]]]
"""Milliseconds of each round by what was measured, a list for each encoder."""


def in_process(encoders: list[Encoder], maps: list[Map], frames: list[bytes], rounds: int) -> Times:
    """Processor time of the two parts of a query in which encoders differ, and their sum."""
    times: Times = defaultdict(lambda: [[] for _ in encoders])
    pixels = [decode(frame) for frame in frames]
    for turn in range(WARM_UP + rounds):
        shown = pixels[turn % len(pixels)]
        for number, (encoder, map_) in enumerate(zip(encoders, maps, strict=True)):
            began = time.process_time()
            encoding = encoder.encode(shown)
            encoded = time.process_time()
            scope = map_.scope(None)
            ranking = scope.search(encoding.descriptor[np.newaxis])[0]
            searched = time.process_time()
            agree(map_, encoder, scope, encoding.descriptor, encoding.local, ranking)
            ended = time.process_time()
            if turn < WARM_UP:
                continue
            parts = {"encoding": encoded - began, "second stage": ended - searched}
            for name, spent in {**parts, TOGETHER: sum(parts.values())}.items():
                times[name][number].append(1e3 * spent)
    return times


def over_http(process: Process, maps: list[str], frames: list[bytes], rounds: int) -> Times:
    """The time until an answer, and processor time of the service, of blocks of queries."""
    times: Times = defaultdict(lambda: [[] for _ in maps])
    for turn in range(1 + -(-rounds // BLOCK)):  # the first one warms up
        block = [frames[(turn * BLOCK + index) % len(frames)] for index in range(BLOCK)]
        for number, map_id in enumerate(maps):
            before, waited = process.processor_time(), []
            for frame in block:
                began = time.perf_counter()
                answer = process.client.post(
                    f"/v1/maps/{map_id}/query?verify=never", content=frame, headers={"Content-Type": "image/jpeg"}
                )
                waited.append(1e3 * (time.perf_counter() - began))
                answer.raise_for_status()
            if turn:
                times[ANSWER][number] += waited
                spent = process.processor_time() - before
                times[SERVED][number].append(1e3 * spent / BLOCK)
    return times


def main(
    encoder: Annotated[list[str] | None, typer.Option(help="Two, by name or identity.")] = None,
    places: Annotated[int, typer.Option(min=2)] = 300,
    rounds: Annotated[int, typer.Option(min=10)] = 60,
    threads: Annotated[int, typer.Option(min=1, help="Of a forward pass, there and here.")] = 1,
) -> None:
    """Take turns and compare."""
    configure_malloc()  # as the service does
    share_cores(threads)
    names = encoder or ["m-region-vlad-thesis", DEFAULT_ENCODER]
    if len(names) != 2:
        raise typer.BadParameter("two encoders are compared")
    catalogue = EncoderCatalogue()
    encoders = [catalogue.get(name) for name in names]
    known, content = camera_frames(places, "reference")
    frames, _ = camera_frames(64)
    with tempfile.TemporaryDirectory() as text:
        folder, ids = Path(text), ["first", "second"]
        for map_id, one in zip(ids, encoders, strict=True):
            encodings = one.encode_batch([decode(frame) for frame in known])
            write_map(folder / "data", map_id, one, ((found.descriptor, found.local) for found in encodings))
        shutil.copytree(folder / "data", folder / "copy")  # the service holds its own alone
        atlas = Directory(folder / "copy")
        times = in_process(encoders, [atlas.get(map_id) for map_id in ids], frames, rounds)
        atlas.close()
        with service(folder / "data", threads) as process:
            times |= over_http(process, ids, frames, rounds)
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {}
    for name, (first, second) in times.items():
        a, b = median(first), median(second)
        if name == SERVED:  # the system counts it in hundredths of a second
            a, b = float(np.mean(first)), float(np.mean(second))
        rows.append((name, a, b, f"{b / a:.3f}", verdict(b / a, LIMIT) if name in JUDGED else ""))
        figures[name] = {"milliseconds": [a, b], "ratio": b / a}
    identities = [one.identity for one in encoders]
    title = f"{' and '.join(one[:24] for one in identities)}, {places} places, {content}, {threads} threads"
    report(
        "encoders",
        title,
        ["ms", "first", "second", "ratio", ""],
        rows,
        {"encoders": identities, "places": places, "rounds": rounds, "measured": figures},
    )


if __name__ == "__main__":
    typer.run(main)
