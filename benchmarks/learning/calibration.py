"""Maps that calibrate themselves: ``python -m benchmarks.learning.calibration --datasets ../shared/datasets``.

One run in a condition tells a map which places its frames show, without a label; the calibration that follows is judged
by the next run in that condition: in the map as it is, in either half of it, so that half of the frames are strangers
that look much like the map, and by a robot that is elsewhere.  Probabilities are those of single frames, and truth is
that of the data sets, which tolerates two frames.  Beside it stands what the true places of the same run would have
given.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.learning.__main__ import encoded, encoded_run
from benchmarks.learning.learner import EncodedRun, run_frames
from benchmarks.learning.living_map import SAME_PLACE, EncodedPicture, LivingMap
from benchmarks.learning.worlds import WORLDS, RobotWorld
from benchmarks.learning.year import ATTACKER, RunPlan, curve
from benchmarks.maps.aligned_maps import NO_REGIONS
from benchmarks.report import report
from core.judgement.calibration import Target, adjust_calibration
from core.judgement.reliability import reliability
from core.judgement.trials import StagedTrials, joined_stages
from core.judgement.verdict import Calibration
from core.learning import PlacedFrame, lesson_of, placed_frames, trials_of
from core.maps import Enrolment, MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.places import PlaceFields, Pose
from core.recognition.calibration import LabelledQueries, LabelledQuery, run_trials
from core.store import Directory, Map
from service.maps.self_calibration import LEAST_FRAMES

FIRST = 900
"""Number of the first run."""

PRECISE = Target(rule="precision", value=0.95)

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Calibrated:
    """How a calibration does on some answers, of which those that leave doubt are verified.

    error, brier: of the probabilities.
    recognized, wrong: answers.
    strangers, highest: the mean and the highest probability of a frame whose place the map lacks.
    """

    error: float
    brier: float
    recognized: int
    wrong: int
    strangers: float
    highest: float

    @classmethod
    def of(cls, trials: StagedTrials, calibration: Calibration) -> Calibrated:
        """Judge some trials by a calibration; some are of strangers."""
        answers = trials.answered(calibration)
        stated, believed = answers.probabilities(calibration), answers.recognized(calibration)
        found, strangers = reliability(stated, answers.right), stated[~answers.known]
        wrong = int((believed & ~answers.right).sum())
        return cls(found.ece, found.brier, int(believed.sum()), wrong, float(strangers.mean()), float(strangers.max()))


class AskedMap:
    """A map of a world that is asked frames of known places, in memory and in a store: its rows are the same."""

    def __init__(self, encoder: Encoder, world: RobotWorld, atlas: Directory) -> None:
        first = encoded(encoder, world.first, world.keypoints)
        points, headings = curve(world.spacing * np.arange(len(first)))
        positions = np.column_stack([points.real, points.imag])
        self.encoder, self.world, self.places = encoder, world, len(first)
        self.living = LivingMap(encoder, first, positions, headings)
        settings = MapSettings(keep="none", same_place_radius=SAME_PLACE.radius, same_place_frames=SAME_PLACE.frames)
        self.map: Map = atlas.create(world.name, encoder.identity, encoder.dimension, settings, encoder.local_shape)
        poses = [
            Pose(x=float(x), y=float(y), heading=float(np.degrees(heading) % 360))
            for (x, y), heading in zip(positions, headings, strict=True)
        ]
        self.map.enrol([
            Enrolment(
                f"p{number}", PlaceFields(pose=pose, sequence="first"), one.descriptor, 1, number.to_bytes(32, "big"),
                local=one.local, keypoints=one.keypoints,
            )
            for number, (one, pose) in enumerate(zip(first, poses, strict=True))
        ])  # fmt: skip

    def answers(self, run: EncodedRun, absent: Flags | None = None) -> StagedTrials:
        """The answers to the frames of a run, with the truth about them.

        Args:
            absent: bool [places], those that are left out of the map; None: none.
        """
        nothing = np.zeros(self.places, np.bool_)
        made = (
            LabelledQuery(
                frame.descriptor,
                frame.local,
                nothing if moment.at is None else self.world.right[moment.at],
                nothing if absent is None else absent,
                nothing,
                frame.keypoints,
            )
            for moment, frame in zip(run.moments, run.frames, strict=True)
        )
        queries = LabelledQueries(len(run.frames), made)
        base, snapshot = self.encoder.calibration, self.map.snapshot()
        return run_trials(self.map, self.encoder, snapshot, queries, base, _silent, without_place=0)

    def told(self, placed: Sequence[PlacedFrame], frames: Sequence[EncodedPicture]) -> Calibration:
        """The calibration that follows from frames whose places are told; the old one if they are too few, as in a
        service."""
        base = self.encoder.calibration
        if len(placed) < LEAST_FRAMES:
            return base
        some = [frames[one.number] for one in placed]
        encodings = [Encoding(one.descriptor, one.local, NO_REGIONS, {}) for one in some]
        trials = trials_of(self.map, self.encoder, placed, encodings, [one.keypoints for one in some], _silent)
        return adjust_calibration(trials, base, "runs", PRECISE).calibration


def _silent(_done: int, _total: int) -> None:
    """Reports no progress."""


def truth_of(world: RobotWorld, run: EncodedRun) -> list[PlacedFrame]:
    """The true places of the frames of a run."""
    shown = [None if one.at is None else np.flatnonzero(world.right[one.at]) for one in run.moments]
    return [
        PlacedFrame(number, None if rows is None else int(rows[len(rows) // 2]))
        for number, rows in enumerate(shown)
        if rows is None or len(rows)
    ]


def examined(encoder: Encoder, world: RobotWorld, seed: int, folder: Path) -> dict[str, Any]:
    """Every condition of a world: what one run says, and what that does for the next one."""
    atlas = Directory(folder)
    asked, told = AskedMap(encoder, world, atlas), {}
    graph, first_half = asked.living.graph(), np.arange(asked.places) < asked.places // 2
    for condition in world.conditions:
        plans = (
            RunPlan(FIRST, condition, "robot 0", ("detour",)),
            RunPlan(FIRST + 1, condition, "robot 1", ("detour", "stands")),
            RunPlan(FIRST + 2, condition, "stranger", (ATTACKER,)),
        )
        run, later, elsewhere = (encoded_run(encoder, world, plan, seed) for plan in plans)
        frames = run_frames(run, asked.living.recognize(run.frames), graph)
        placed = placed_frames(lesson_of(frames, graph), frames)
        mistaken = sum(not _true(world, run, one) for one in placed)
        trials = {
            "whole": asked.answers(later),
            "halves": joined_stages([asked.answers(later, half) for half in (first_half, ~first_half)]),
            "elsewhere": asked.answers(elsewhere),
        }
        calibrations = {
            "before": encoder.calibration,
            "after": asked.told(placed, run.frames),
            "labels": asked.told(truth_of(world, run), run.frames),
        }
        told[condition] = {
            "frames": len(frames),
            "told": len(placed),
            "mistaken": mistaken,
            **{
                name: {when: asdict(Calibrated.of(some, one)) for when, one in calibrations.items()}
                for name, some in trials.items()
            },
        }
        print(world.name, condition, told[condition], flush=True)
    atlas.close()
    return told


def _true(world: RobotWorld, run: EncodedRun, placed: PlacedFrame) -> bool:
    """Whether a frame shows the place that a run tells of it."""
    at = run.moments[placed.number].at
    return at is None if placed.row is None else at is not None and bool(world.right[at, placed.row])


def rows_of(name: str, told: dict[str, Any]) -> list[tuple[object, ...]]:
    """The rows of a world."""

    def errors(one: dict[str, Any]) -> str:
        return f"{one['before']['error']:.3f} → {one['after']['error']:.3f} ({one['labels']['error']:.3f})"

    def counted(one: dict[str, Any]) -> str:
        return " → ".join(f"{one[when]['recognized']} ({one[when]['wrong']})" for when in ("before", "after"))

    def strangers(one: dict[str, Any]) -> str:
        return " → ".join(f"{one[when]['strangers']:.2f}, {one[when]['highest']:.2f}" for when in ("before", "after"))

    return [
        (
            f"{name}, {condition}",
            f"{one['told']}/{one['frames']} ({one['mistaken']})",
            *(part(one[which]) for which in ("whole", "halves") for part in (errors, counted)),
            *(strangers(one[which]) for which in ("halves", "elsewhere")),
            " → ".join(str(one["elsewhere"][when]["recognized"]) for when in ("before", "after")),
        )
        for condition, one in told.items()
    ]


COLUMNS = ("", "told", "error", "recognized", "halves: error", "recognized", "strangers", "elsewhere", "recognized")
"""Frames of a run whose place the rest of it knew, of all, and in brackets those told wrongly; the calibration error on
the next run, before and after, and in brackets with the true places of the first run; and its frames that are
recognized, in brackets wrongly; both with either half of the map alone; there, and of a robot elsewhere, the mean and
the highest probability of strangers; and how many of the latter are recognized."""


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    worlds: Annotated[str, typer.Option(help="Names with commas.")] = ",".join(WORLDS),
    seed: Annotated[int, typer.Option(help="Of the runs.")] = 0,
    encoder: Annotated[str, typer.Option(help="Name of the encoder.")] = DEFAULT_ENCODER,
) -> None:
    """Print a line for each condition and a table, and store the figures."""
    chosen, told = EncoderCatalogue().get(encoder), {}
    for name in worlds.split(","):
        with tempfile.TemporaryDirectory() as folder:
            told[name] = examined(chosen, WORLDS[name](datasets), seed, Path(folder))
    rows = [row for name, one in told.items() for row in rows_of(name, one)]
    report("self-calibration", f"{chosen.name}: one run calibrates the next", COLUMNS, rows, {"worlds": told})


if __name__ == "__main__":
    typer.run(main)
