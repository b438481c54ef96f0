"""One 640x480 JPEG, decoding included, against torch's own forward pass: at most 1.3 times.

The passes of torch and of the encoder are timed with one thread, too, as each frame has it when several wait.

python -m benchmarks.encode [--image FILE]
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.report import report, verdict
from core.frames.images import decode
from core.frames.preprocessing import contrast, prepare
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.method.vlad import aggregate
from core.threads import allowed_threads, cores, share_cores, use_threads
from service.commands.timing.samples import jpeg, sample_frame
from service.commands.timing.stages import better_forward, encoding_runs, medians
from service.malloc import configure_malloc

LIMIT = 1.3
TOGETHER = 8
"""Frames encoded at once, for what one of them costs then."""


def one_thread_runs(passes: dict[str, Callable[[], object]]) -> dict[str, Callable[[], object]]:
    """The same with one thread."""

    def alone(run: Callable[[], object]) -> Callable[[], object]:
        def work() -> None:
            threads = allowed_threads()
            use_threads(1)
            run()
            use_threads(threads)

        return work

    return {f"{name}, one thread": alone(run) for name, run in passes.items()}


def stage_runs(encoder: Encoder, data: bytes) -> dict[str, Callable[[], object]]:
    """Each stage of an encoding by itself, in order."""
    extractor, definition = encoder.extractor, encoder.definition
    pixels, stage = decode(data), definition.agreement
    image = prepare(pixels, extractor.backbone.input)[None]
    maps = extractor.activations([pixels])[0]
    products = extractor.products(maps)
    features, words = extractor.regions(maps, products).features, encoder.centers

    runs: dict[str, Callable[[], object]] = {
        "· decode": lambda: decode(data),
        "· resize and scale": lambda: prepare(pixels, extractor.backbone.input),
        "· contrast": lambda: contrast(pixels),
        "· forward": lambda: extractor.forward(image),
        "· products": lambda: extractor.products(maps),
        "· regions": lambda: extractor.regions(maps, products),
        "· VLAD": lambda: aggregate(features, words, definition.gamma, definition.normalization),
    }
    if stage is not None:
        runs["· local descriptors"] = lambda: encoder.local(maps, products)
    return runs


def main(
    encoder: str = DEFAULT_ENCODER,
    image: Annotated[Path | None, typer.Option(help="Default: a sample frame.")] = None,
    rounds: Annotated[int, typer.Option(min=3)] = 60,
    threads: Annotated[int, typer.Option(min=0, help="0: every core.")] = 0,
) -> None:
    """Medians of interleaved runs."""
    configure_malloc()  # as the service does
    share_cores(threads or cores())
    data = jpeg(sample_frame()) if image is None else image.read_bytes()
    chosen = EncoderCatalogue().get(encoder)
    frames = [sample_frame(seed) for seed in range(TOGETHER)]
    together = f"encode_batch, each of {TOGETHER}"
    runs = encoding_runs(chosen, data)
    passes = {name: run for name, run in runs.items() if name not in ("encode", "decode", "regions")}
    stages = stage_runs(chosen, data)
    one = one_thread_runs({**passes, "· forward": stages["· forward"]})
    whole = {"encode": runs["encode"], together: lambda: chosen.encode_batch(frames)}
    times = medians({**passes, **stages, **one, **whole}, rounds, warm_up=5)
    times[together] /= TOGETHER
    forward = better_forward(times)
    ratio = times["encode"] / forward
    rows = [
        (name, spent, spent / forward, verdict(ratio, LIMIT) if name == "encode" else "")
        for name, spent in times.items()
    ]
    figures = {"encoder": chosen.identity, "milliseconds": times, "forward": forward, "ratio": ratio}
    report("encode", f"{chosen.name}, {allowed_threads()} threads", ["", "ms", "of forward", ""], rows, figures)


if __name__ == "__main__":
    typer.run(main)
