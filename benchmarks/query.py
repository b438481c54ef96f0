"""A query over HTTP against 1622 places, end to end, against the bare forward pass: at most 6 times.

    python -m benchmarks.query

The service is a process of its own; the forward pass runs here, in turns with the queries, on the
same cores.  Of the places 60 are encoded pictures, the others are made of parts of these.
"""

from __future__ import annotations

import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Annotated

import torch
import typer

from benchmarks.process import fill_map, median, service
from benchmarks.report import report, verdict
from core.evaluation.timing import forward_passes, jpeg, sample_picture
from core.frames.images import decode
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue

LIMIT = 6.0
SETTLE = 0.01
"""Seconds between two measurements: threads of the one before stop spinning."""


def main(
    encoder: str = DEFAULT_ENCODER,
    places: Annotated[int, typer.Option(min=2)] = 1622,
    rounds: Annotated[int, typer.Option(min=3)] = 60,
    threads: Annotated[int, typer.Option(min=0, help="Of a forward pass, there and here; 0: torch's choice.")] = 0,
) -> None:
    """Medians of interleaved runs."""
    if threads:
        torch.set_num_threads(threads)
    chosen = EncoderCatalogue().get(encoder)
    data = jpeg(sample_picture(7))
    passes = forward_passes(chosen, decode(data))
    times: dict[str, list[float]] = defaultdict(list)
    stages: dict[str, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        fill_map(Path(folder), "benchmark", chosen, places)
        with service(Path(folder), threads) as process:

            def query() -> dict[str, float]:
                answer = process.client.post(
                    "/v1/maps/benchmark/query", content=data, headers={"Content-Type": "image/jpeg"}
                )
                answer.raise_for_status()
                found: dict[str, float] = answer.json()["milliseconds"]
                return found

            for index in range(rounds + 5):
                for name, run in {**passes, "query": query}.items():
                    time.sleep(SETTLE)
                    began = time.perf_counter()
                    answered = run()
                    spent = 1e3 * (time.perf_counter() - began)
                    if index >= 5:  # after a warm-up
                        times[name].append(spent)
                        if isinstance(answered, dict):
                            for stage, milliseconds in answered.items():
                                stages[stage].append(milliseconds)
    forward = min(median(times[name]) for name in passes)
    whole = median(times["query"])
    ratio = whole / forward
    rows: list[tuple[object, ...]] = [("bare forward pass", forward, 1.0, "")]
    rows.append(("query, end to end", whole, ratio, verdict(ratio, LIMIT)))
    rows += [(f"  of it {name}", median(spent), median(spent) / forward, "") for name, spent in stages.items()]
    figures = {
        "encoder": chosen.identity,
        "places": places,
        "milliseconds": {name: median(spent) for name, spent in times.items()},
        "stages": {name: median(spent) for name, spent in stages.items()},
        "forward": forward,
        "ratio": ratio,
    }
    report("query", f"{chosen.name}, {places} places", ["", "ms", "of forward", ""], rows, figures)


if __name__ == "__main__":
    typer.run(main)
