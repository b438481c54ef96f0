"""A year in which maps learn from their robots: ``python -m benchmarks.learning --datasets ../shared/datasets``.

Each world is walked a dozen times by two robots in changing conditions, with 5 % of odometry drift, detours, a
kidnapping, stops, and once by a robot in another building with the same odometry.  After every run the table says
what the map recognizes, in three ways: it stays as it is, a perfect reviewer takes every right proposal, or what
independent evidence agrees on is taken.  A last run in each condition, which teaches nothing, is the examination.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.learning.learner import EncodedRun, Learner, Mode, Tally
from benchmarks.learning.living_map import EncodedPicture, LivingMap
from benchmarks.learning.worlds import WORLDS, RobotWorld
from benchmarks.learning.year import Plan, curve, moments, year
from benchmarks.report import report
from core.belief import view_of
from core.frames.preprocessing import Pixels
from core.geometry.detection import find_keypoints
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import packaged_xfeat
from core.threads import cores, each

MODES: tuple[Mode, ...] = ("off", "propose", "auto")
EXAMINED = 500
"""Numbers of the runs of the examination begin here."""


def encoded(encoder: Encoder, pictures: Sequence[Pixels], keypoints: bool) -> list[EncodedPicture]:
    """Encode pictures, eight at a time."""
    batches = [pictures[start : start + 8] for start in range(0, len(pictures), 8)]
    made = [one for batch in batches for one in encoder.encode_batch(batch)]
    network = packaged_xfeat() if keypoints else None
    found = [None] * len(pictures) if network is None else each(lambda one: find_keypoints(network, one), pictures, cores())
    return [EncodedPicture(one.descriptor, one.local, points) for one, points in zip(made, found, strict=True)]


def encoded_run(encoder: Encoder, world: RobotWorld, plan: Plan, seed: int) -> EncodedRun:
    """A run with its encoded frames."""
    frames = moments(world, plan, seed)
    pictures = [one.pixels for one in frames]
    return EncodedRun(plan, frames, encoded(encoder, pictures, world.keypoints), [view_of(one) for one in pictures])


def lived(encoder: Encoder, world: RobotWorld, runs: int, seed: int) -> dict[str, Any]:
    """The year of one world in every mode."""
    first = encoded(encoder, world.first, world.keypoints)
    points, headings = curve(world.spacing * np.arange(len(first)))
    positions = np.column_stack([points.real, points.imag])
    learners = {mode: Learner(world, LivingMap(encoder, first, positions, headings), first, mode) for mode in MODES}
    told: list[dict[str, Any]] = []
    for plan in year(world, runs):
        run = encoded_run(encoder, world, plan, seed)
        tallies = {mode: learner.live(run) for mode, learner in learners.items()}
        told.append({"run": plan.number, "condition": plan.condition, "events": plan.events} | {
            mode: asdict(tally) for mode, tally in tallies.items()
        })
        print(_line(world, plan, tallies), flush=True)
    exam: dict[str, Any] = {mode: {} for mode in MODES}
    for number, condition in enumerate(world.conditions):
        run = encoded_run(encoder, world, Plan(EXAMINED + number, condition, "examiner"), seed)
        for mode, learner in learners.items():
            tally = learner.examine(run)
            exam[mode][condition] = {"frames": tally.frames, "right": tally.right, "wrong": tally.wrong}
    return {"places": len(first), "runs": told, "examination": exam}


def _line(world: RobotWorld, plan: Plan, tallies: dict[Mode, Tally]) -> str:
    parts = [f"{world.name} {plan.number:4d} {plan.condition:13s} {' '.join(plan.events):16s}"]
    for mode, one in tallies.items():
        parts.append(
            f"{mode}: {one.right:3d}/{one.frames} wrong {one.wrong:2d}"
            + (
                ""
                if mode == "off"
                else f" prop {one.proposed}-{one.proposed_wrong} took {one.taken}-{one.taken_wrong} out {one.withdrawn}"
                f" rows {one.rows} {one.contradiction or ''}"
            )
        )
    return " | ".join(parts) + f" | {tallies['auto'].refused} {tallies['auto'].milliseconds:.1f} ms"


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    worlds: Annotated[str, typer.Option(help="Names with commas.")] = ",".join(WORLDS),
    runs: Annotated[int, typer.Option(help="Runs of the year.")] = 12,
    seed: int = 0,
    encoder: str = DEFAULT_ENCODER,
) -> None:
    """Print the table and keep the figures."""
    chosen = EncoderCatalogue().get(encoder)
    figures: dict[str, Any] = {"encoder": chosen.identity}
    for name in worlds.split(","):
        figures[name] = lived(chosen, WORLDS[name](datasets), runs, seed)
        for mode in MODES:
            print(name, mode, figures[name]["examination"][mode])
    report("learning", chosen.name, ["", "", ""], [], figures)


if __name__ == "__main__":
    typer.run(main)
