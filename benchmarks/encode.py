"""One 640x480 JPEG, decoding included, against the bare forward pass: at most 2.5 times.

python -m benchmarks.encode [--image FILE]
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import torch
import typer

from benchmarks.report import report, verdict
from core.encoders import DEFAULT_ENCODER, EncoderCatalogue
from service.measurement import better_forward, encoding_runs, jpeg, medians, sample_picture

LIMIT = 2.5


def main(
    encoder: str = DEFAULT_ENCODER,
    image: Annotated[Path | None, typer.Option(help="Default: a picture made here.")] = None,
    rounds: Annotated[int, typer.Option(min=3)] = 60,
    threads: Annotated[int, typer.Option(min=0, help="0: torch's own choice.")] = 0,
) -> None:
    """Medians of interleaved runs."""
    if threads:
        torch.set_num_threads(threads)
    data = jpeg(sample_picture()) if image is None else image.read_bytes()
    chosen = EncoderCatalogue().get(encoder)
    times = medians(encoding_runs(chosen, data), rounds, warm_up=5)
    stages = chosen.encode(sample_picture()).milliseconds
    forward = better_forward(times)
    ratio = times["encode"] / forward
    rows = [
        (name, spent, spent / forward, verdict(ratio, LIMIT) if name == "encode" else "")
        for name, spent in times.items()
    ]
    figures = {"encoder": chosen.identity, "milliseconds": times, "stages": stages, "forward": forward, "ratio": ratio}
    report("encode", f"{chosen.name}, {torch.get_num_threads()} threads", ["", "ms", "of forward", ""], rows, figures)


if __name__ == "__main__":
    typer.run(main)
