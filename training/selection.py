"""The encoder's constants, compared on the validation tasks over several vocabularies each.

Prints a Markdown table: one row a configuration, the mean over the seeds of k-means and the largest
difference between two of them.  The corridor traverse stands last, for the reader; nothing is
chosen by it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.progress import track
from safetensors.torch import load_file

from core.encoder import EncoderDefinition, FeatureExtractor
from core.evaluation import auc_pr
from core.preprocessing import Pixels
from core.presets import PRESETS
from core.vlad import aggregate
from core.vocabulary import pool_features, train_vocabulary
from training.packaging import Tasks, load_tasks, network_of, vocabulary_pictures
from training.validation import DISTRACTORS, Walk, camera_recall, walk

Array = NDArray[np.float32]

LAYERS = ("conv3", "conv4")
DEFAULT = PRESETS["m-region-vlad"]
CHANGES: dict[str, dict[str, Any]] = {
    "packaged": {},
    "raw sums": {"unit_features": False},
    "global": {"normalization": "global"},
    "raw sums, global (as the thesis's code)": {"unit_features": False, "normalization": "global"},
    "step 0.1": {"steps": (0.1, 0.1)},
    "step 0.5": {"steps": (0.5, 0.5)},
    "step 1.0": {"steps": (1.0, 1.0)},
    "step 1.5": {"steps": (1.5, 1.5)},
    "step 3.0": {"steps": (3.0, 3.0)},
    "N = 150": {"regions": 150},
    "N = 600": {"regions": 600},
    "V = 64": {"words": 64},
    "V = 256": {"words": 256},
    "γ = 0.2": {"gamma": 0.2},
    "γ = 1": {"gamma": 1.0},
    "conv3 alone, N = 600": {"layers": ("conv3",), "steps": (2.0,), "regions": 600},
    "conv4 alone, N = 600": {"layers": ("conv4",), "steps": (2.0,), "regions": 600},
}
COLUMNS = ("lip6 recall@1", "lip6 AUC-PR", "webcams recall@1", "night recall@1", "corridor recall@1", "corridor AUC-PR")


class Study:
    """Activations of all pictures, computed once, and the figures of any configuration on them."""

    def __init__(self, weights: Path, datasets: Path, images: int) -> None:
        tensors = load_file(weights)
        self.extractor = FeatureExtractor(network_of(tensors, LAYERS), DEFAULT)
        self.network = tensors
        self.tasks: Tasks = load_tasks(datasets)
        self.corridor = walk(datasets / "eval/corridor", "query", "ref")
        shown: dict[str, list[Pixels]] = {
            "vocabulary": vocabulary_pictures(datasets, images, seed=0),
            "lip6 queries": self.tasks.lip6.queries,
            "lip6 references": self.tasks.lip6.references,
            "corridor queries": self.corridor.queries,
            "corridor references": self.corridor.references,
            "webcams": self.tasks.webcams.pictures,
            "night": self.tasks.night.pictures,
        }
        self.activations = {
            name: [self.extractor.activations([picture])[0] for picture in track(pictures, f"activations, {name}")]
            for name, pictures in shown.items()
        }

    def features(self, definition: EncoderDefinition) -> dict[str, list[Array]]:
        """Regional features, T x K a picture, of every picture set."""
        extractor = FeatureExtractor(network_of(self.network, definition.layers), definition)
        chosen = [LAYERS.index(layer) for layer in definition.layers]
        return {
            name: [extractor.regions([maps[index] for index in chosen]).features for maps in pictures]
            for name, pictures in self.activations.items()
        }

    def figures(self, definition: EncoderDefinition, features: dict[str, list[Array]], seed: int) -> list[float]:
        """One number for each of COLUMNS."""
        vocabulary = train_vocabulary(pool_features(features["vocabulary"], seed), definition.words, seed, "study")
        vlads = {
            name: np.stack(
                [aggregate(f, vocabulary.centers, definition.gamma, definition.normalization) for f in frames]
            )
            for name, frames in features.items()
            if name != "vocabulary"
        }
        far = vlads["lip6 references"][:DISTRACTORS]
        return [
            *_walked(self.tasks.lip6, vlads["lip6 queries"] @ vlads["lip6 references"].T),
            camera_recall(self.tasks.webcams, vlads["webcams"], far),
            camera_recall(self.tasks.night, vlads["night"], far),
            *_walked(self.corridor, vlads["corridor queries"] @ vlads["corridor references"].T),
        ]


def _walked(task: Walk, products: Array) -> tuple[float, float]:
    """recall@1 and AUC-PR of a traverse pair."""
    best = products.argmax(axis=1)
    matched = task.truth[np.arange(len(best)), best]
    return float(matched.mean()), auc_pr(products.max(axis=1), matched)


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
    output: Annotated[Path, typer.Option(help="JSON with every run.")] = Path("runs/selection.json"),
    images: Annotated[int, typer.Option(min=1, help="Photographs for each vocabulary.")] = 800,
    seeds: Annotated[int, typer.Option(min=1, help="Vocabularies a configuration.")] = 3,
    only: Annotated[list[str] | None, typer.Option(help="Just these configurations.")] = None,
) -> None:
    """Compare the configurations of CHANGES."""
    study = Study(weights, datasets, images)
    rows: dict[str, Sequence[Sequence[float]]] = {}
    for name, change in CHANGES.items():
        if only and name not in only:
            continue
        definition = DEFAULT.model_copy(update=change)
        features = study.features(definition)
        rows[name] = [study.figures(definition, features, seed) for seed in range(seeds)]
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(json.dumps({"columns": COLUMNS, "rows": rows}, indent=1))
        typer.echo(table({name: rows[name]}).splitlines()[-1])
    typer.echo(table(rows))


if __name__ == "__main__":
    typer.run(main)
