"""Encoding a JPEG against the thesis's pipeline written literally, on this machine: at least 40 times faster.

python -m benchmarks.thesis.thesis_pipeline

Both give M-Region-VLAD as the thesis has it (N = 300 of conv3 and conv4 each, V = 128), on the packaged network, from
the bytes of one frame to the vector.  The literal pipeline's time grows with the number of regions, so it is measured
at the default encoder's step, which leaves under a thousand a layer, and at that of the packaged thesis encoder, which
leaves some thirteen thousand, as the thesis's networks do at a step of 1.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from benchmarks.report import report, verdict
from benchmarks.thesis.reference_pipeline import reference_encode
from core.frames.images import decode
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.method.regions import extract_regions
from core.method.vlad import aggregate
from core.networks.network import ShallowNetwork
from core.networks.torch_network import TorchNetwork
from service.commands.timing.samples import jpeg, sample_frame
from service.commands.timing.stages import medians

LIMIT = 40.0
THESIS = "m-region-vlad-thesis"


def literal(encoder: Encoder, data: bytes, step: float) -> NDArray[np.float32]:
    """The frame by the literal pipeline, with the encoder's network and words."""
    backbone: Any = encoder.extractor.backbone
    shown, definition = backbone.input, encoder.definition
    network = _plain(backbone)
    size = (shown.width, shown.height)
    return reference_encode(data, network, size, shown.mean, shown.scale, step, definition.regions, encoder.centers)


_PLAIN: dict[int, torch.nn.Module] = {}


def _plain(backbone: ShallowNetwork) -> torch.nn.Module:
    """The network as torch builds it, maps after maps in memory, as frames come from the literal pipeline."""
    if id(backbone) not in _PLAIN:
        _PLAIN[id(backbone)] = TorchNetwork.of(backbone).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    return _PLAIN[id(backbone)]


def ours(encoder: Encoder, data: bytes, step: float, words: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same vector as this project computes it, at any step."""
    definition = encoder.definition
    layers = encoder.extractor.activations([decode(data)])[0]
    regions = extract_regions(layers, (step,) * len(layers), definition.regions)
    return aggregate(regions.features, words, definition.gamma, definition.normalization)


def main(rounds: Annotated[int, typer.Option(min=3)] = 15) -> None:
    """Compare the vectors, then the times."""
    thesis, default = EncoderCatalogue().get(THESIS), EncoderCatalogue().get(DEFAULT_ENCODER)
    data, coarse, fine = jpeg(sample_frame()), default.definition.steps[0], thesis.definition.steps[0]
    words = thesis.centers
    for step in (coarse, fine):
        a, b = literal(thesis, data, step), ours(thesis, data, step, words)
        cosine = float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
        # Where two regions have nearly the same energy, the last of the N may be another one.
        assert cosine > 0.995, f"the pipelines disagree at a step of {step}: cosine {cosine:.4f}"

    times = medians(
        {
            "literal": lambda: literal(thesis, data, coarse),
            "literal, fine": lambda: literal(thesis, data, fine),
            "ours": lambda: ours(thesis, data, coarse, words),
            "ours, fine": lambda: ours(thesis, data, fine, words),
            "default": lambda: default.encode(decode(data)),
        },
        rounds,
        warm_up=2,
    )
    ratios = {
        "coarse": times["literal"] / times["ours"],
        "fine": times["literal, fine"] / times["ours, fine"],
        "default encoder": times["literal"] / times["default"],
    }
    rows = [
        (f"literal pipeline, step {coarse:g}", times["literal"], 1.0, ""),
        (
            "the same vector here",
            times["ours"],
            ratios["coarse"],
            verdict(ratios["coarse"], LIMIT, True),
        ),
        (f"the default encoder ({DEFAULT_ENCODER})", times["default"], ratios["default encoder"], ""),
        (f"literal pipeline, step {fine:g}", times["literal, fine"], 1.0, ""),
        (
            "the same vector here",
            times["ours, fine"],
            ratios["fine"],
            verdict(ratios["fine"], LIMIT, True),
        ),
    ]
    columns = ["", "ms", "times faster", ""]
    report("thesis_pipeline", "A JPEG to its vector", columns, rows, {"milliseconds": times, "ratios": ratios})


if __name__ == "__main__":
    typer.run(main)
