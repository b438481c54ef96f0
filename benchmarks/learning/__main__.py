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

from benchmarks.learning.learner import EncodedRun, Learner, Mode, RunTally
from benchmarks.learning.living_map import EncodedPicture, LivingMap
from benchmarks.learning.worlds import WORLDS, RobotWorld
from benchmarks.learning.year import RunPlan, curve, moments, year
from benchmarks.report import report, verdict
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

PART, GAP, LEARNT, WRONG, ROWS = 0.9, 2 / 3, 500, 0.002, 3.0
"""Bars of ``auto``."""


def encoded(encoder: Encoder, pictures: Sequence[Pixels], keypoints: bool) -> list[EncodedPicture]:
    """Encode pictures, eight at a time."""
    batches = [pictures[start : start + 8] for start in range(0, len(pictures), 8)]
    made = [one for batch in batches for one in encoder.encode_batch(batch)]
    network = packaged_xfeat() if keypoints else None
    found = (
        [None] * len(pictures) if network is None else each(lambda one: find_keypoints(network, one), pictures, cores())
    )
    return [EncodedPicture(one.descriptor, one.local, points) for one, points in zip(made, found, strict=True)]


def encoded_run(encoder: Encoder, world: RobotWorld, plan: RunPlan, seed: int) -> EncodedRun:
    """A run with its encoded frames."""
    frames = moments(world, plan, seed)
    pictures = [one.pixels for one in frames]
    return EncodedRun(plan, frames, encoded(encoder, pictures, world.keypoints), [view_of(one) for one in pictures])


def lived(encoder: Encoder, world: RobotWorld, runs: int, seed: int, any_score: bool = False) -> dict[str, Any]:
    """The year of one world in every mode, run by run, and its examination.

    Args:
        any_score: looks are believed from any score on, and not from that which stands out of their cohort.
    """
    first = encoded(encoder, world.first, world.keypoints)
    points, headings = curve(world.spacing * np.arange(len(first)))
    positions = np.column_stack([points.real, points.imag])
    learners = {
        mode: Learner(world, LivingMap(encoder, first, positions, headings), first, mode, any_score) for mode in MODES
    }
    told: list[dict[str, Any]] = []
    for plan in year(world, runs):
        run = encoded_run(encoder, world, plan, seed)
        tallies = {mode: learner.live(run) for mode, learner in learners.items()}
        print(line(world, plan, tallies), flush=True)
        parts: dict[str, Any] = {mode: asdict(tally) for mode, tally in tallies.items()}
        told.append({"run": plan.number, "condition": plan.condition, "events": plan.events} | parts)
    exam: dict[str, dict[str, Any]] = {mode: {} for mode in MODES}
    for number, condition in enumerate(world.conditions):
        run = encoded_run(encoder, world, RunPlan(EXAMINED + number, condition, "examiner"), seed)
        for mode, learner in learners.items():
            tally = learner.examine(run)
            exam[mode][condition] = {"frames": tally.frames, "right": tally.right, "wrong": tally.wrong}
    left = {mode: learner.left() for mode, learner in learners.items()}
    return {"places": len(first), "runs": told, "examination": exam, "left": left}


def line(world: RobotWorld, plan: RunPlan, tallies: dict[Mode, RunTally]) -> str:
    """One run in a line: recognized and right, wrong, and the looks of each mode."""
    parts = [f"{world.name} {plan.number:4d} {plan.condition:13s} {' '.join(plan.events):15s}"]
    for mode, one in tallies.items():
        text = f"{mode} {one.right}/{one.frames}, {one.wrong} wrong"
        if mode != "off":
            text += (
                f", {one.proposed} proposed ({one.proposed_wrong} wrong), {one.taken} taken ({one.taken_wrong} wrong), "
                f"{one.withdrawn} withdrawn, {one.rows} rows" + (f", {one.contradiction}" if one.contradiction else "")
            )
        parts.append(f"{text}, {one.milliseconds:.1f} ms")
    return " | ".join(parts)


def total(lives: Sequence[dict[str, Any]], mode: Mode) -> dict[str, float]:
    """The figures of a mode over some worlds."""
    exams = [one for life in lives for one in life["examination"][mode].values()]
    runs = [run[mode] for life in lives for run in life["runs"]]
    places = sum(life["places"] for life in lives)
    return {
        "frames": sum(one["frames"] for one in exams),
        "right": sum(one["right"] for one in exams),
        "wrong": sum(one["wrong"] for one in exams),
        "right in the year": sum(one["right"] for one in runs),
        "wrong in the year": sum(one["wrong"] for one in runs),
        "taken": sum(one["taken"] for one in runs),
        "taken wrongly": sum(one["taken_wrong"] for one in runs),
        "attacker's taken": sum(one["attackers"] for one in runs),
        "withdrawn": sum(one["withdrawn"] for one in runs),
        "looks": sum(life["left"][mode]["looks"] for life in lives),
        "wrong looks": sum(life["left"][mode]["wrong"] for life in lives),
        "attacker's looks": sum(life["left"][mode]["attackers"] for life in lives),
        "rows": sum(life["left"][mode]["rows"] for life in lives) / places,
        "ms": float(np.mean([life["runs"][-1][mode]["milliseconds"] for life in lives])),
    }


def rows_of(name: str, lives: Sequence[dict[str, Any]]) -> list[tuple[object, ...]]:
    """The rows of the table for some worlds."""
    rows: list[tuple[object, ...]] = []
    for mode in MODES:
        found = total(lives, mode)
        rows.append(
            (
                f"{name}, {mode}",
                f"{found['right'] / found['frames']:.3f}",
                f"{found['wrong']:.0f}/{found['frames']:.0f}",
                f"{found['right in the year']:.0f}, {found['wrong in the year']:.0f}",
                f"{found['taken']:.0f} ({found['taken wrongly']:.0f})",
                f"{found['withdrawn']:.0f}",
                f"{found['wrong looks']:.0f}/{found['looks']:.0f}",
                f"{found['rows']:.2f}",
                f"{found['ms']:.1f}",
            )
        )
    return rows


def bars(lives: Sequence[dict[str, Any]]) -> dict[str, str]:
    """The bars for what is taken without a person, and whether they are met."""
    off, best, auto = (total(lives, mode) for mode in MODES)
    gap = (auto["right"] - off["right"]) / max(best["right"] - off["right"], 1)
    learnt = auto["taken wrongly"] / max(auto["taken"], 1)
    return {
        "right, against a perfect reviewer": verdict(auto["right"] / best["right"], PART, at_least=True),
        "of the gap closed": verdict(gap, GAP, at_least=True),
        "wrong, against off": verdict(auto["wrong"], off["wrong"]),
        "looks learnt": verdict(auto["taken"], LEARNT, at_least=True),
        "of these wrong": verdict(learnt, WRONG),
        "of the attacker, left": verdict(auto["attacker's looks"], 0),
        "rows, against the first map": verdict(auto["rows"], ROWS),
    }


COLUMNS = ("", "right", "wrong", "in the year", "taken", "withdrawn", "left", "rows", "ms")
"""In the examination recognized and right, as a share of the frames, and wrong; in the year right, and wrong; looks
that were taken, those of wrong places in brackets; looks that were withdrawn; wrong looks that are left, and all; rows,
in those of the first map; and the time that an answer takes, without encoding."""


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    worlds: Annotated[str, typer.Option(help="Names with commas.")] = ",".join(WORLDS),
    runs: Annotated[int, typer.Option(help="Runs of the year, besides the attacker's.")] = 12,
    short: Annotated[bool, typer.Option("--short", help="Half of the year, in the corridor alone.")] = False,
    seed: Annotated[int, typer.Option(help="Of the runs.")] = 0,
    any_score: Annotated[bool, typer.Option("--any-score", help="Believe a learnt look from any score on.")] = False,
    encoder: Annotated[str, typer.Option(help="Name of the encoder.")] = DEFAULT_ENCODER,
) -> None:
    """Print a line for each run and a table, and store the figures."""
    if short:
        worlds, runs = "corridor", min(runs, 6)
    chosen = EncoderCatalogue().get(encoder)
    names = worlds.split(",")
    lives = {name: lived(chosen, WORLDS[name](datasets), runs, seed, any_score) for name in names}
    rows = [row for name in names for row in rows_of(name, [lives[name]])]
    if len(names) > 1:
        rows += rows_of("all", list(lives.values()))
    met = bars(list(lives.values()))
    figures = {"encoder": chosen.identity, "bars": met, "worlds": lives}
    report("learning", f"{chosen.name}: a year of {runs} runs", COLUMNS, rows, figures)
    for name, text in met.items():
        print(f"{name} {text}")


if __name__ == "__main__":
    typer.run(main)
