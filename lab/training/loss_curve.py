"""Draws the losses of a distillation, on fresh crops and on photographs held out of training, over the crops seen."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated

import typer
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def draw_loss_curve(log: Path, output: Path) -> None:
    """Draw ``log.csv``, which the distillation writes, as a PNG.

    Raises:
        ValueError: the log has no row.
    """
    with log.open(newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ValueError(f"{log} has no row yet")
    crops = [int(row["crops"]) / 1000 for row in rows]
    figure = Figure(figsize=(7, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for name, label in (("loss", "training"), ("held_out_loss", "held out, averaged weights")):
        values = [float(row[name]) for row in rows]
        (line,) = axes.plot(crops, values, marker=".")
        axes.annotate(f" {label}", (crops[-1], values[-1]), color=line.get_color(), va="center")
    axes.set_xlabel("thousand crops")
    axes.set_ylabel("1 − cosine to the teacher, two layers")
    axes.set_xlim(0, crops[-1] * 1.4)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(output, dpi=120)


def main(
    log: Annotated[Path, typer.Option(help="log.csv of a run.")] = Path("runs/distillation/log.csv"),
    output: Annotated[Path, typer.Option(help="The PNG to write.")] = Path("runs/distillation/curve.png"),
) -> None:
    """Draw the loss curve."""
    draw_loss_curve(log, output)


if __name__ == "__main__":
    typer.run(main)
