"""``placerec bench``: how fast this machine recognizes places, in this process or through a running service."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.commands.connection.client import CommandTarget, ask, path_of, read_bytes
from service.commands.connection.credentials import given_key
from service.commands.console import Failure, number, progress, show, table, write_file
from service.commands.encoders.models import ModelsDir, default_encoder, open_catalogue

if TYPE_CHECKING:
    from core.method.encoder import Encoder

FRAMES = 16
"""Frames that are encoded together, and that the robots send in turn."""


def bench(
    image: Annotated[Path | None, typer.Option(help="Frame to encode. Default: 640x480 JPEGs drawn for this.")] = None,
    encoder: Annotated[str | None, typer.Option(help="Encoder by name or identity.", show_default=False)] = None,
    places: Annotated[int, typer.Option(min=1, help="Places to search among.")] = 1622,
    rounds: Annotated[int, typer.Option(min=3, help="Runs of each stage; the median is shown.")] = 30,
    threads: Annotated[int, typer.Option(min=0, help="Threads of a forward pass; 0: every core.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the figures.")] = None,
    models_dir: ModelsDir = None,
    url: Annotated[str | None, typer.Option(help="Measure the service at this address instead.")] = None,
    map_id: Annotated[
        str | None, typer.Option("--map", "-m", help="With --url: the map to query. Default: frames are only encoded.")
    ] = None,
    robots: Annotated[
        list[int] | None,
        typer.Option(
            min=1, max=1000, help="With --url: number of robots at a time; may be repeated. Default: 1, 4 and 16."
        ),
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=0.2, max=600, help="With --url: seconds for each number of robots.")
    ] = 5.0,
) -> None:
    """Measure encoding, stage by stage and in batches, and the search of a map, in this process.

    With --url: measure how a running service answers 1, 4 and 16 robots, each of which sends its next frame when it
    has the answer to the last. Nothing in the service is changed.
    """
    if url is None:
        figures = _measure_here(image, encoder, places, rounds, threads, models_dir)
    else:
        figures = _measure_service(url, map_id, image, robots or [1, 4, 16], seconds)
    if json_file is not None:
        write_file(json_file, json.dumps(figures, indent=2) + "\n")


def _measure_here(
    image: Path | None, encoder: str | None, places: int, rounds: int, threads: int, models_dir: Path | None
) -> dict[str, Any]:
    # Imported here because they take a second.
    from core.threads import cores, share_cores
    from service.commands.timing.samples import jpeg, sample_frame
    from service.commands.timing.stages import better_forward, encode_batch, encoding_runs, medians, search_run

    share_cores(threads or cores())
    chosen: Encoder = open_catalogue(models_dir).get(encoder or default_encoder())
    data = jpeg(sample_frame()) if image is None else read_bytes(image)
    with progress() as bar:
        bar.add_task("Measuring", total=None)
        batch = {"batch": lambda: encode_batch(chosen, [data] * FRAMES)}
        with search_run(chosen, places) as search:
            times = medians({**encoding_runs(chosen, data), **batch, "search": search}, rounds)
        times["batch"] /= FRAMES
    forward = better_forward(times)
    shown = table("what", "#ms", "#of a forward pass", title=f"{chosen.name}, {threads or cores()} threads")
    for name, milliseconds in [("bare forward pass", forward), *times.items()]:
        called = {"search": f"search of {places}", "batch": f"encode, {FRAMES} together, each"}.get(name, name)
        shown.add_row(called, number(milliseconds, 2), number(milliseconds / forward, 2))
    show(shown)
    return {
        "encoder": chosen.identity,
        "threads": threads or cores(),
        "places": places,
        "milliseconds": {"forward": forward, **times},
        "ratio": {"encode": times["encode"] / forward},
        "batched_frames_per_second": 1e3 / times["batch"],
    }


def _measure_service(
    url: str, map_id: str | None, image: Path | None, robots: list[int], seconds: float
) -> dict[str, Any]:
    import subprocess

    from service.commands.load import measure
    from service.commands.timing.samples import jpeg, sample_frame

    path = path_of("encode") if map_id is None else path_of("maps", map_id, "query")
    version = ask(CommandTarget(url, None), "GET", "/version").json()
    frames = [read_bytes(image)] if image else [jpeg(sample_frame(index)) for index in range(FRAMES)]
    seen: dict[str, Any] = {}
    shown = table("robots", "#answers/s", "#p50 ms", "#p95 ms", "#p99 ms", "#refused", title=f"{url}{path}")
    with tempfile.TemporaryDirectory() as text, progress() as bar:
        folder = Path(text)
        for index, data in enumerate(frames):
            # A frame that the service refuses ends the command before the measurement.
            ask(CommandTarget(url, None), "POST", path, content=data, headers={"Content-Type": "image/jpeg"})
            (folder / f"{index}.jpg").write_bytes(data)
        task = bar.add_task("Driving", total=len(robots))
        for count in robots:
            try:
                found = measure(url, path, folder, count, seconds, given_key())
            except subprocess.CalledProcessError as error:
                raise Failure(f"{url} hung up on the robots: is it still there?") from error
            seen[str(count)] = one = summary(found)
            times = (number(one[name], 1) for name in ("p50", "p95", "p99"))
            shown.add_row(str(count), number(one["per_second"], 1), *times, str(one["refused"]))
            bar.advance(task)
    show(shown)
    return {"url": url, "path": path, "service": version, "seconds": seconds, "robots": seen}


def summary(found: Mapping[str, Any]) -> dict[str, Any]:
    """Percentiles in milliseconds, answers per second and refusals of a load's measurement."""
    import numpy as np

    times = np.array(found["milliseconds"])
    statuses: Mapping[str, int] = found["statuses"]
    return {
        "answers": len(times),
        "per_second": len(times) / found["seconds"],
        **{f"p{p}": float(np.percentile(times, p)) for p in (50, 95, 99)},
        "statuses": statuses,
        "refused": sum(count for status, count in statuses.items() if status != "200"),
    }
