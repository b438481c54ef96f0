"""The encoder's constants, varied one at a time and compared on the validation tasks over several vocabularies each.

Prints a Markdown table: one row a configuration, the mean over the seeds of k-means and half the
largest difference between two of them.  The corridor traverse stands last, for the reader; nothing is
chosen by it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.progress import track
from safetensors.torch import load_file

from core.frames.preprocessing import Pixels
from core.judgement.curves import auc_pr
from core.method.encoder import Encoder, EncoderDefinition
from core.method.features import FeatureExtractor
from core.method.presets import PRESETS
from core.method.projection import Projection
from core.method.vocabulary import pool_features, train_vocabulary
from core.networks.torch_network import TorchNetwork
from lab.training.default_calibration import UNCALIBRATED
from lab.training.packaging import network_of, vocabulary_pictures
from lab.training.projections import fit_cell_projections, fit_projections, paired_cells, refine
from lab.training.validation import (
    DISTRACTORS,
    Encodings,
    ValidationTasks,
    camera_recall,
    camera_scores,
    load_tasks,
    load_traverses,
    scores,
)

Array = NDArray[np.float32]

DEFAULT = PRESETS["m-region-vlad"]
assert DEFAULT.agreement is not None
STAGE = DEFAULT.agreement
OUTPUTS = DEFAULT.outputs
WIDEST = {"pool2": 64, "conv3": 384, "conv4": 384}
"""The number of directions fitted for each layer; every configuration takes the first of them."""
THESIS: dict[str, Any] = {"unit_features": False, "projection": None, "agreement": None, "steps": (0.1, 0.1)}
COARSE = {**THESIS, "steps": DEFAULT.steps}
PLAIN: dict[str, Any] = {
    "centred": None, "screened": None, "taught": None, "weights": (0.4, 0.4, 0.2), "share": 0.75,
}  # fmt: skip
"""The second stage of 0.1.0, in what differs from the packaged one."""
LIGHT: dict[str, Any] = {**PLAIN, "centred": 0.75, "weights": (0.45, 0.45, 0.1), "reach": (3, 5)}
"""The same with standardized cells, less weight for conv4 and a longer reach."""


def _stage(**change: Any) -> dict[str, Any]:
    return {"agreement": STAGE.model_copy(update=change)}


CHANGES: dict[str, dict[str, Any]] = {
    "packaged": {},
    "without the second stage": {"agreement": None},
    "without second stage and projection": {"agreement": None, "projection": None},
    "as the thesis (raw sums)": THESIS,
    "as the thesis's code (raw sums, global)": {**THESIS, "normalization": "global"},
    "as the thesis but for the step": COARSE,
    "as the thesis's code but for the step": {**COARSE, "normalization": "global"},
    "global": {"normalization": "global"},
    "step 0.5": {"steps": (0.5, 0.5)},
    "step 1.0": {"steps": (1.0, 1.0)},
    "step 3.0": {"steps": (3.0, 3.0)},
    "N = 150": {"regions": 150},
    "N = 600": {"regions": 600},
    "V = 64": {"words": 64},
    "V = 256, 64 values": {"words": 256, "projection": 64},
    "γ = 0.2": {"gamma": 0.2},
    "γ = 1": {"gamma": 1.0},
    "projection to 64": {"projection": 64},
    "projection to 256": {"projection": 256},
    "conv3 alone, N = 600": {"layers": ("conv3",), "steps": (2.0,), "regions": 600},
    "conv4 alone, N = 600": {"layers": ("conv4",), "steps": (2.0,), "regions": 600},
    "second stage: conv3 alone": _stage(layers=("conv3",), weights=(1.0,)),
    "second stage: pool2 and conv3": _stage(layers=("pool2", "conv3"), weights=(0.5, 0.5)),
    "second stage: three layers alike": _stage(weights=(0.34, 0.33, 0.33)),
    "second stage: 32 values": _stage(values=32),
    "second stage: reach 1, 3": _stage(reach=(1, 3)),
    "second stage: reach 3, 5": _stage(reach=(3, 5)),
    "second stage: reach 3, 7": _stage(reach=(3, 7)),
    "second stage: 10 candidates": _stage(candidates=10),
    "second stage: 60 candidates": _stage(candidates=60, screened=None),
    "second stage: 30 candidates, none screened": _stage(screened=None),
    "second stage: 60 screened": _stage(screened=60),
    "second stage: 20 candidates": _stage(candidates=20),
    "second stage: weights 0.4, 0.4, 0.2": _stage(weights=(0.4, 0.4, 0.2)),
    "second stage: share 0.5": _stage(share=0.5),
    "second stage: share 0.75": _stage(share=0.75),
    "second stage: cells as they are": _stage(centred=None),
    "second stage: projections of the regions": _stage(taught=None),
    "second stage: of 0.1.0": _stage(**PLAIN),
    "second stage: of 0.1.0, cells standardized": _stage(**{**PLAIN, "centred": 0.75}),
    "second stage: of 0.1.0, cells standardized, weights 0.45, 0.45, 0.1, reach 3, 5, 60 candidates": _stage(
        **LIGHT, candidates=60
    ),
    "second stage: of 0.1.0, cells standardized, these weights and reach, 15 candidates of 60 screened": _stage(
        **{**LIGHT, "candidates": 15, "screened": 60}
    ),
}
REFINED = "projections refined by contrastive learning"
REFINEMENT_CROPS, REFINEMENT_STEPS = 800, 400
COLUMNS = (
    "lip6 recall@1", "lip6 AUC-PR", "lip6 as stated, recall@1", "webcams recall@1", "night recall@1",
    "corridor recall@1", "corridor AUC-PR",
)  # fmt: skip


class Ablation:
    """Activations of all pictures, computed once, and the figures of any configuration on them."""

    def __init__(self, weights: Path, datasets: Path, images: int, size: tuple[int, int] | None = None) -> None:
        self.weights, self.size = load_file(weights), size
        network = self._network(DEFAULT)
        self.projections = fit_projections(network, WIDEST, datasets / "train")
        self.extractor = FeatureExtractor(network.as_data(), DEFAULT, self.projections)
        self.tasks: ValidationTasks = load_tasks(datasets)
        self.corridor = load_traverses(datasets / "eval/corridor", "query", "ref")
        shown: dict[str, list[Pixels]] = {
            "vocabulary": vocabulary_pictures(datasets, images, seed=0),
            "lip6 queries": self.tasks.lip6.queries,
            "lip6 references": self.tasks.lip6.references,
            "corridor queries": self.corridor.queries,
            "corridor references": self.corridor.references,
            "webcams": self.tasks.webcams.pictures,
            "night": self.tasks.night.pictures,
        }
        self.activations = {name: self._activations(name, pictures) for name, pictures in shown.items()}
        self.cells: dict[str, Projection] = {}
        plain = DEFAULT.model_copy(update=_stage(taught=None))
        self.cells = fit_cell_projections(self.encoder(plain, 0), STAGE, datasets / "train")

    def _activations(self, name: str, pictures: Sequence[Pixels]) -> list[dict[str, NDArray[np.float16]]]:
        made = []
        for picture in track(pictures, f"activations, {name}"):
            maps = self.extractor.activations([picture])[0]
            made.append({layer: values.astype(np.float16) for layer, values in zip(OUTPUTS, maps, strict=True)})
        return made

    def maps(self, name: str, definition: EncoderDefinition) -> list[list[Array]]:
        """The activations that a definition reads, for every picture of a set."""
        return [[frame[layer].astype(np.float32) for layer in definition.outputs] for frame in self.activations[name]]

    def describe(self, encoder: Encoder, name: str) -> Encodings:
        """Encode every picture of a set."""
        made = [encoder.describe(maps) for maps in self.maps(name, encoder.definition)]
        return Encodings(np.stack([one.descriptor for one in made]), np.stack([one.local for one in made]))

    def refine(self, datasets: Path) -> None:
        """Refine the projections by contrastive learning; both stages use these from now on, but for taught cells."""
        network = network_of(self.weights, STAGE.layers)
        pairs = paired_cells(network, datasets / "train", REFINEMENT_CROPS)
        refined, losses = refine(self.projections, STAGE, pairs, REFINEMENT_STEPS)
        typer.echo(f"refinement: loss {np.mean(losses[:20]):.3f} at first, {np.mean(losses[-20:]):.3f} at last")
        for layer, projection in refined.items():
            further = self.projections[layer].matrix[:, STAGE.values :]
            self.projections[layer] = Projection(projection.mean, np.hstack([projection.matrix, further]))

    def encoder(self, definition: EncoderDefinition, seed: int) -> Encoder:
        """The encoder of a configuration with a vocabulary of its own, not calibrated."""
        extractor = FeatureExtractor(
            self._network(definition).as_data(), definition, self._projections(definition), self._cells(definition)
        )
        frames = (extractor.regions(maps).features for maps in self.maps("vocabulary", definition))
        vocabulary = train_vocabulary(pool_features(frames, seed), definition.words, seed, extractor.origin)
        return Encoder("ablation", extractor, definition, vocabulary, UNCALIBRATED)

    def figures(self, definition: EncoderDefinition, seed: int) -> list[float]:
        """One number for each of COLUMNS."""
        encoder = self.encoder(definition, seed)
        references = self.describe(encoder, "lip6 references")
        far = references.part(slice(0, DISTRACTORS))
        lip6 = scores(encoder, self.describe(encoder, "lip6 queries"), references)
        corridor = scores(
            encoder, self.describe(encoder, "corridor queries"), self.describe(encoder, "corridor references")
        )
        return [
            *_traverse_figures(self.tasks.lip6.truth, lip6),
            _traverse_figures(self.tasks.lip6_as_stated.truth, lip6)[0],
            *(
                camera_recall(task, *camera_scores(encoder, self.describe(encoder, name), far))
                for name, task in (("webcams", self.tasks.webcams), ("night", self.tasks.night))
            ),
            *_traverse_figures(self.corridor.truth, corridor),
        ]

    def _network(self, definition: EncoderDefinition) -> TorchNetwork:
        return network_of(self.weights, definition.outputs, self.size)

    def _projections(self, definition: EncoderDefinition) -> dict[str, Projection]:
        return {layer: self.projections[layer] for layer in definition.projected()}

    def _cells(self, definition: EncoderDefinition) -> dict[str, Projection]:
        stage = definition.agreement
        return {layer: self.cells[layer] for layer in stage.layers} if stage is not None and stage.taught else {}


def _traverse_figures(truth: NDArray[np.bool_], answers: Array) -> tuple[float, float]:
    """recall@1 and AUC-PR of a traverse pair."""
    best = answers.argmax(axis=1)
    matched = truth[np.arange(len(best)), best]
    return float(matched.mean()), auc_pr(answers.max(axis=1), matched)


def table(rows: dict[str, Sequence[Sequence[float]]]) -> str:
    """Markdown; each cell the mean over seeds ± half the spread."""
    lines = ["| configuration | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for name, runs in rows.items():
        values = np.array(runs)
        half = (values.max(axis=0) - values.min(axis=0)) / 2
        cells = [f"{mean:.3f} ± {spread:.3f}" for mean, spread in zip(values.mean(axis=0), half, strict=True)]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(
    weights: Annotated[Path, typer.Option(help="Folded weights of the distillation.")] = Path(
        "runs/distillation/weights.safetensors"
    ),
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    output: Annotated[Path, typer.Option(help="JSON with every run.")] = Path("runs/ablation.json"),
    images: Annotated[int, typer.Option(min=1, help="Photographs for each vocabulary.")] = 600,
    size: Annotated[
        tuple[int, int] | None, typer.Option(metavar="HEIGHT WIDTH", help="Another input size than the network's own.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Vocabularies a configuration.")] = 3,
    only: Annotated[list[str] | None, typer.Option(help="Just these configurations.")] = None,
) -> None:
    """Compare the configurations of CHANGES."""
    torch.manual_seed(0)
    ablation = Ablation(weights, datasets, images, size)
    rows: dict[str, Sequence[Sequence[float]]] = {}
    for name, change in CHANGES.items():
        if only and name not in only:
            continue
        definition = EncoderDefinition.model_validate({**DEFAULT.model_dump(), **change})
        rows[name] = [ablation.figures(definition, seed) for seed in range(seeds)]
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(json.dumps({"columns": COLUMNS, "rows": rows}, indent=1))
        typer.echo(table({name: rows[name]}).splitlines()[-1])
    if not only or REFINED in only:
        ablation.refine(datasets)
        definition = DEFAULT.model_copy(update=_stage(taught=None))
        rows[REFINED] = [ablation.figures(definition, seed) for seed in range(seeds)]
        output.write_text(json.dumps({"columns": COLUMNS, "rows": rows}, indent=1))
    typer.echo(table(rows))


if __name__ == "__main__":
    typer.run(main)
