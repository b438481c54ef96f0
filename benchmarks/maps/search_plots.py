"""Figures for the documents: cost against map size, and how like real places the distractors are.

    python -m benchmarks.maps.search_plots [--output docs/figures]

``search-cost.png`` shows what ``benchmarks.maps.search`` measured last, with and without ``--million``; the times of
the second are scaled by the flat search that both runs timed.  ``distractors.png`` is computed: of every
query, the best score among as many distractors as there are photographs of other real places, and among those.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import matplotlib
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.maps.references import Material, material
from benchmarks.report import RESULTS
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue

matplotlib.use("Agg")
from matplotlib import pyplot as plt

Array = NDArray[np.float32]

TIERS = {"flat": "flat float32 (FAISS)", "compact": "compact"}
BLOCK = 2000
SHARED_PLACES = 100_000


def cost(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Milliseconds and bytes in memory against places, one line a tier."""
    figure, (time, memory) = plt.subplots(1, 2, figsize=(10, 4))
    for tier, label in TIERS.items():
        chosen = sorted((row for row in rows if row["tier"] == tier), key=lambda row: int(row["places"]))
        places = [row["places"] for row in chosen]
        time.plot(places, [row["milliseconds"] for row in chosen], "o-", label=label)
        memory.plot(places, [row["places"] * row["memory"] / 1e9 for row in chosen], "o-", label=label)
    for axes, what in ((time, "ms a query"), (memory, "GB in memory")):
        axes.set(xscale="log", yscale="log", xlabel="places", ylabel=what)
        axes.grid(True, which="major", alpha=0.3)
        axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def measured() -> list[dict[str, Any]]:
    """The rows of the last runs; those of the million scaled by the flat search that both runs timed."""
    rows: list[dict[str, Any]] = json.loads((RESULTS / "search.json").read_text())["rows"]
    path = RESULTS / "search-million.json"
    if not path.exists():
        return rows
    further: list[dict[str, Any]] = json.loads(path.read_text())["rows"]
    steady, busy = (next(row["milliseconds"] for row in run if _is_flat(row)) for run in (rows, further))
    scaled = [{**row, "milliseconds": row["milliseconds"] * steady / busy} for row in further]
    return rows + [row for row in scaled if row["places"] > SHARED_PLACES]


def _is_flat(row: dict[str, Any]) -> bool:
    """The flat search of the size that both runs have."""
    return bool(row["tier"] == "flat" and row["places"] == SHARED_PLACES)


def best_scores(queries: Array, of: Material, distractors: bool) -> Array:
    """Of each query the best score against the sources, or against as many distractors: float32 [q]."""
    count, offset = len(of.sources), len(of.places)
    best = np.full(len(queries), -np.inf, np.float32)
    for start in range(0, count, BLOCK):
        stop = min(count, start + BLOCK)
        block = of.references(offset + start, offset + stop) if distractors else of.sources[start:stop]
        best = np.maximum(best, (queries @ block.T).max(axis=1))
    return best / np.float32(of.words)


def histogram(path: Path, of: Material) -> dict[str, list[float]]:
    """Draw the three distributions; their deciles."""
    groups = {
        "other real places": best_scores(of.queries, of, distractors=False),
        "as many distractors": best_scores(of.queries, of, distractors=True),
        "the place itself": np.asarray((of.queries @ of.places.T).max(axis=1) / of.words, np.float32),
    }
    figure, axes = plt.subplots(figsize=(7, 4))
    for label, scores in groups.items():
        axes.hist(scores, bins=np.arange(0.03, 0.5, 0.006).tolist(), histtype="step", linewidth=1.5, label=label)
    axes.set(xlabel=f"best score of a query among {len(of.sources):,} (J / V)", ylabel="queries")
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return {label: np.percentile(scores, np.arange(10, 100, 10)).round(4).tolist() for label, scores in groups.items()}


def main(
    output: Annotated[Path, typer.Option(help="Folder of the figures.")] = Path("docs/figures"),
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    cache: Annotated[Path, typer.Option(help="Where encoded photographs are stored.")] = Path(".cache/references"),
) -> None:
    """Draw both."""
    cost(output / "search-cost.png", measured())
    deciles = histogram(output / "distractors.png", material(datasets, EncoderCatalogue().get(DEFAULT_ENCODER), cache))
    for label, values in deciles.items():
        print(f"{label:<20} deciles of the best score: {' '.join(f'{value:.4f}' for value in values)}")


if __name__ == "__main__":
    typer.run(main)
