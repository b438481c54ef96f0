"""Measures the default calibration of packaged encoders again and stores it; nothing is trained, identities stay."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from core.method.catalogue import ENCODER_SUFFIX, NETWORK_SUFFIX, PACKAGED, load_encoder, save_calibration
from core.method.presets import NETWORK, PRESETS
from training.packaging import assess, load_tasks


def main(
    datasets: Annotated[Path, typer.Option(help="Folder with train/ and eval/.")] = Path("../shared/datasets"),
    models: Annotated[Path, typer.Option(help="Folder of the model files.")] = PACKAGED,
    encoder: Annotated[list[str] | None, typer.Option(help="Which; all presets if left out.")] = None,
    dry_run: Annotated[bool, typer.Option(help="Measure and print, store nothing.")] = False,
) -> None:
    """Measure the calibration of each encoder on the validation tasks, print it with all figures, and store it."""
    tasks = load_tasks(datasets)
    for name in encoder or list(PRESETS):
        path = models / f"{name}{ENCODER_SUFFIX}"
        loaded = load_encoder(path, models / f"{NETWORK}{NETWORK_SUFFIX}")
        calibration, figures = assess(loaded, tasks)
        if not dry_run:
            save_calibration(path, calibration)
            load_encoder(path, models / f"{NETWORK}{NETWORK_SUFFIX}").check_golden()
        made = {"encoder": loaded.identity, "calibration": calibration.model_dump(), **figures}
        typer.echo(json.dumps(made, indent=2))


if __name__ == "__main__":
    typer.run(main)
