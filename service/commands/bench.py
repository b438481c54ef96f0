"""``placerec bench``: how fast this machine recognizes places."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from service.commands.client import read_bytes
from service.commands.console import number, progress, show, table, write_file
from service.commands.models import ModelsDir, default_encoder, open_catalogue


def bench(
    image: Annotated[Path | None, typer.Option(help="Frame to encode; default: a 640x480 JPEG made here.")] = None,
    encoder: Annotated[str | None, typer.Option(help="Encoder by name or identity.", show_default=False)] = None,
    places: Annotated[int, typer.Option(min=1, help="Places to search among.")] = 1622,
    rounds: Annotated[int, typer.Option(min=3, help="Runs of each; the median counts.")] = 30,
    threads: Annotated[int, typer.Option(min=0, help="Threads of a forward pass; 0 uses every core.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the figures.")] = None,
    models_dir: ModelsDir = None,
) -> None:
    """Measure encoding against the bare forward pass, the region pass, and a search of both stages, in this process.

    What is compared runs interleaved. The scripts in benchmarks/ measure the rest: queries over HTTP, the region
    pass against its reference, start and memory.
    """
    # Imported here because they take a second.
    import numpy as np
    import torch

    from core.storage.descriptors import ROWS_PER_SEGMENT
    from core.storage.snapshot import Snapshot, Spot
    from core.verdict import NO_POSE
    from service.localization import examine
    from service.measurement import better_forward, encoding_runs, jpeg, medians, sample_picture

    if threads:
        torch.set_num_threads(threads)
    chosen = open_catalogue(models_dir).get(encoder or default_encoder())
    data = jpeg(sample_picture()) if image is None else read_bytes(image)
    with progress() as bar:
        bar.add_task("Measuring", total=None)
        random, middle = np.random.default_rng(0), places // 2
        known = random.standard_normal((places, chosen.dimension), np.float32)
        local = random.integers(-127, 128, (places, *chosen.local_shape), np.int8)
        nowhere = Spot(NO_POSE, (0.0, 0.0, 0.0), -1, 0)
        empty = Snapshot(chosen.dimension, ROWS_PER_SEGMENT, local_shape=chosen.local_shape)
        snapshot = empty.appended(list(known), [nowhere] * places, list(local))

        def search() -> object:
            return examine(chosen, snapshot, local[middle], snapshot.search(known[middle]))

        times = medians({**encoding_runs(chosen, data), "search": search}, rounds)
    forward = better_forward(times)
    figures = {
        "encoder": chosen.identity,
        "threads": torch.get_num_threads(),
        "places": places,
        "milliseconds": {"forward": forward, **times},
        "ratio": {"encode": times["encode"] / forward},
    }
    shown = table("what", "#ms", "#of a forward pass", title=f"{chosen.name}, {figures['threads']} threads")
    for name, milliseconds in [("bare forward pass", forward), *times.items()]:
        shown.add_row(
            f"search of {places}" if name == "search" else name,
            number(milliseconds, 2),
            number(milliseconds / forward, 2),
        )
    show(shown)
    if json_file is not None:
        write_file(json_file, json.dumps(figures, indent=2) + "\n")
