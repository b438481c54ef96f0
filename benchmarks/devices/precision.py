"""Cosines of descriptors whose forward pass has a lower precision to those of float32; one identity promises 0.999.

python -m benchmarks.devices.precision FOLDER [FOLDER …]
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, get_args

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.report import report
from core.frames.images import decode
from core.method.catalogue import EncoderCatalogue
from core.networks.backbone import Precision

ENCODERS = ("m-region-vlad", "m-region-vlad-thesis")


def cosines(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    """Of the rows of two arrays: float64 [n]."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    return np.asarray((a * b).sum(1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)))


def main(
    folders: Annotated[list[Path], typer.Argument(help="Folders of frames.")],
    every: Annotated[int, typer.Option(min=1, help="Take every so-manyth frame.")] = 4,
) -> None:
    """Mean and least cosine by encoder and precision, computed by torch on the processor."""
    files = [path for folder in folders for path in sorted(folder.iterdir())][::every]
    frames = [decode(path.read_bytes()) for path in files]
    rows, figures = [], {}
    for name in ENCODERS:
        encoder = EncoderCatalogue().get(name)
        exact = np.stack([encoder.encode(frame).descriptor for frame in frames])
        for precision in get_args(Precision)[1:]:
            encoder.extractor.compute(precision)
            found = cosines(exact, np.stack([encoder.encode(frame).descriptor for frame in frames]))
            rows.append((f"{name}, {precision}", *(f"{value:.4f}" for value in (found.mean(), found.min()))))
            figures[f"{name} {precision}"] = {"mean": float(found.mean()), "least": float(found.min())}
    title = f"{len(frames)} frames"
    report("forward_precision", title, ["encoder, precision", "mean cosine", "least"], rows, figures)


if __name__ == "__main__":
    typer.run(main)
