"""Frames a second on 1, 2, 4, 8, … cores, and with the forward pass on a GPU where there is one.

Frames are decoded; they are encoded together, each in a thread.  The latency is that of a single frame, which has all
threads in its forward pass.  The last column is the least cosine of the descriptors to those of one core: an encoder
identity promises 0.999.

python -m benchmarks.devices.throughput [--images FOLDER]
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from benchmarks.report import processor, report
from core.frames.images import decode
from core.frames.preprocessing import Pixels
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.backbone import Device
from core.threads import cores, share_cores
from service.commands.timing.samples import sample_frame
from service.malloc import configure_malloc

ON_A_GPU = 4
"""Threads to a core where the forward pass is on a GPU, for a thread sleeps while it is computed there."""


def thread_counts(most: int, device: Device) -> list[int]:
    """1, 2, 4, … up to a number, and that number; on a GPU up to ``ON_A_GPU`` times as many."""
    top = most * (ON_A_GPU if device == "cuda" else 1)
    return sorted({*(2**power for power in range(top.bit_length())), top})


def frames_per_second(encoder: Encoder, frames: Sequence[Pixels], seconds: float) -> float:
    """Frames encoded together, again and again for some seconds."""
    encoder.encode_batch(frames)
    began, made = time.perf_counter(), 0
    while (spent := time.perf_counter() - began) < seconds:
        made += len(encoder.encode_batch(frames))
    return made / spent


def latency(encoder: Encoder, frames: Sequence[Pixels]) -> float:
    """Milliseconds of one frame that has the machine to itself, the median."""
    times = []
    for frame in frames:
        began = time.perf_counter()
        encoder.encode(frame)
        times.append(time.perf_counter() - began)
    return 1e3 * float(np.median(times))


def descriptors(encoder: Encoder, frames: Sequence[Pixels]) -> NDArray[np.float64]:
    """Unit-length descriptors, float64 [n, D]."""
    found = np.stack([encoding.descriptor for encoding in encoder.encode_batch(frames)]).astype(np.float64)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def main(
    encoder: str = DEFAULT_ENCODER,
    images: Annotated[Path | None, typer.Option(help="A folder of frames; default: made-up ones.")] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="For each row.")] = 5.0,
    count: Annotated[int, typer.Option(min=2, help="Frames of one batch.")] = 64,
) -> None:
    """Throughput, latency and identity of the encoder by device and threads."""
    configure_malloc()  # as the service does
    devices: list[Device] = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    if images is None:
        frames = [sample_frame(seed) for seed in range(count)]
    else:
        frames = [decode(path.read_bytes()) for path in sorted(images.iterdir())[:count]]
    share_cores(1)
    expected = descriptors(EncoderCatalogue().get(encoder), frames)
    rows: list[tuple[object, ...]] = []
    figures: list[dict[str, Any]] = []
    for where in devices:
        chosen = EncoderCatalogue(device=where).get(encoder)
        name = torch.cuda.get_device_name() if where == "cuda" else processor()
        for threads in thread_counts(cores(), where):
            share_cores(threads)
            rate, alone = frames_per_second(chosen, frames, seconds), latency(chosen, frames[:30])
            cosine = float((descriptors(chosen, frames) * expected).sum(1).min())
            rows.append((f"{where}, {threads}", rate, alone, f"{cosine:.6f}"))
            figures.append(
                {"device": where, "name": name, "threads": threads, "per_second": rate, "ms": alone, "cosine": cosine}
            )
    columns = ["device, threads", "frames/s", "ms of one", "least cosine"]
    title = f"{encoder} on {', '.join(sorted({row['name'] for row in figures}))}"
    report("throughput", title, columns, rows, {"encoder": chosen.identity, "rows": figures})


if __name__ == "__main__":
    typer.run(main)
