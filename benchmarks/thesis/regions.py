"""The region pass over two layers against the frozen reference: at least 500 times faster.

python -m benchmarks.thesis.regions
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
import typer

from benchmarks.report import report, verdict
from benchmarks.thesis.reference_regions import reference_regions
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.features import FeatureExtractor
from core.method.regions import extract_regions
from service.commands.timing.samples import sample_frame
from service.commands.timing.stages import medians

LIMIT = 500.0


def main(
    encoder: str = DEFAULT_ENCODER,
    step: Annotated[float | None, typer.Option(help="Quantisation step of every layer; else the encoder's.")] = None,
    rounds: Annotated[int, typer.Option(min=3)] = 9,
) -> None:
    """Compare results, then times."""
    extractor: FeatureExtractor = EncoderCatalogue().get(encoder).extractor
    definition = extractor.definition
    # The layers of the encoder's second stage alone come after those that regions come from.
    layers = extractor.activations([sample_frame()])[0][: len(definition.layers)]
    planes = [np.ascontiguousarray(layer.transpose(2, 0, 1)) for layer in layers]
    steps = definition.steps if step is None else (step,) * len(layers)

    def ours() -> object:
        return extract_regions(layers, steps, definition.regions)

    def reference() -> object:
        return [reference_regions(plane, step, definition.regions) for plane, step in zip(planes, steps, strict=True)]

    for layer, plane, step in zip(layers, planes, steps, strict=True):
        made = extract_regions([layer], [step], definition.regions)
        _, energies, features = reference_regions(plane, step, definition.regions)
        np.testing.assert_allclose(made.energies, energies, rtol=1e-4)
        # Regions of nearly the same energy may change places; the sets of their features may not.
        np.testing.assert_allclose(made.features.sum(axis=0), features.sum(axis=0), rtol=1e-2)

    times = medians({"ours": ours, "reference": reference}, rounds, warm_up=1)
    ratio = times["reference"] / times["ours"]
    rows = [
        ("reference (scikit-image)", times["reference"], 1.0, ""),
        ("region pass", times["ours"], ratio, verdict(ratio, LIMIT, at_least=True)),
    ]
    title = f"Regions of {', '.join(definition.layers)}, N = {definition.regions} each"
    report("regions", title, ["", "ms", "times faster", ""], rows, {"milliseconds": times, "ratio": ratio})


if __name__ == "__main__":
    typer.run(main)
