"""New ground: ``python -m benchmarks.learning.new_ground --datasets ../shared/datasets``.

From the middle of each walk's map a stretch is cut, as if nobody had filmed it.  Robots go along the whole walk with
5 % of odometry drift; what each proposes is compared with where the frames truly are, and taken.  Another run then says
how many of its frames in the gap are recognized, and where, before and after.  A robot in another building with the
same odometry must propose nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.learning.__main__ import encoded, encoded_run
from benchmarks.learning.learner import EncodedRun, run_frames
from benchmarks.learning.living_map import EncodedPicture, LivingMap
from benchmarks.learning.worlds import RobotWorld, corridor, lip6
from benchmarks.learning.year import ATTACKER, RunPlan, curve
from benchmarks.report import report
from core.belief import PlaceGraph
from core.learning import GroundStretch, Trail, cohort_of, least_score, lesson_of, new_ground_of
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder

WORLDS = {"corridor": corridor, "lip6": lip6}
GAP = 3
"""The gap is the middle one of so many parts of the walk."""
EXAMINED = 700
"""Numbers of the runs that examine the map begin here."""


@dataclass(frozen=True)
class GappedWorld:
    """A world whose map lacks the places from ``begin`` to ``end`` (exclusive)."""

    world: RobotWorld
    begin: int
    end: int

    def inside(self, run: EncodedRun) -> list[int]:
        """The frames of a run that show only places that the map lacks."""
        right = self.world.right
        numbers = np.arange(right.shape[1])
        lacking = (numbers >= self.begin) & (numbers < self.end)
        found = ((number, moment.at) for number, moment in enumerate(run.moments))
        return [n for n, at in found if at is not None and right[at].any() and not right[at][~lacking].any()]


def surveyed(map_: LivingMap, run: EncodedRun) -> tuple[tuple[GroundStretch, ...], dict[str, int], PlaceGraph]:
    """The stretches that a run proposes, why there are not more, and the graph of the map."""
    graph = map_.graph()
    frames = run_frames(run, map_.recognize(run.frames), graph)
    lesson = lesson_of(frames, graph)
    if lesson.contradiction is not None:
        return (), {lesson.contradiction: 1}, graph
    found = new_ground_of(frames, graph, lesson)
    return found.stretches, {str(why): count for why, count in found.refused.items()}, graph


def errors_of(
    gap: GappedWorld, map_: LivingMap, run: EncodedRun, stretch: GroundStretch
) -> tuple[NDArray[np.complex128], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Where its keyframes are put and turned, and the errors of both: metres and degrees."""
    x, y = map_.positions[map_.place[stretch.origin]]
    points = np.array([complex(x, y) + one.point for one in stretch.frames])
    headings = np.array([one.heading for one in stretch.frames])
    metres = np.array([gap.world.metres[run.moments[one.frame].at or 0] for one in stretch.frames])
    truly, facing = curve(metres)
    return points, headings, np.abs(points - truly), np.degrees(np.abs(np.angle(np.exp(1j * (headings - facing)))))


def recognized(gap: GappedWorld, map_: LivingMap, run: EncodedRun) -> tuple[int, int, int]:
    """Of the frames in the gap those at a place within the radius, those elsewhere, and all."""
    inside = gap.inside(run)
    truly, _ = curve(gap.world.metres)
    right = wrong = 0
    radius = map_.graph().neighborhood.radius
    for number, answer in zip(inside, map_.recognize([run.frames[one] for one in inside]), strict=True):
        if answer.judgement.verdict == "recognized":
            x, y = map_.positions[map_.place[answer.row]]
            near = bool(abs(complex(x, y) - truly[run.moments[number].at or 0]) <= radius + gap.world.spacing)
            right, wrong = right + near, wrong + (not near)
    return right, wrong, len(inside)


def wrong_elsewhere(gap: GappedWorld, map_: LivingMap, run: EncodedRun) -> int:
    """How many frames outside the gap are recognized farther away than the radius."""
    inside = set(gap.inside(run))
    outside = [n for n, one in enumerate(run.moments) if one.at is not None and n not in inside]
    truly, _ = curve(gap.world.metres)
    wrong, radius = 0, map_.graph().neighborhood.radius
    for number, answer in zip(outside, map_.recognize([run.frames[one] for one in outside]), strict=True):
        if answer.judgement.verdict == "recognized":
            x, y = map_.positions[map_.place[answer.row]]
            wrong += bool(abs(complex(x, y) - truly[run.moments[number].at or 0]) > radius + 2 * gap.world.spacing)
    return wrong


Keyframe = tuple[int, complex, float, float]
"""Of a run: its number, point and heading, and the score from which on a match with it is believed."""


def gapped(
    encoder: Encoder,
    gap: GappedWorld,
    first: Sequence[EncodedPicture],
    run: EncodedRun | None,
    taken: Sequence[Keyframe],
) -> LivingMap:
    """The map without the gap, and with keyframes of a run."""
    left = [n for n in range(len(first)) if not gap.begin <= n < gap.end]
    points, headings = curve(gap.world.spacing * np.array(left))
    frames = [first[n] for n in left]
    leasts = [-np.inf] * len(left)
    if run is not None:
        for number, point, heading, least in taken:
            frames.append(run.frames[number])
            points, headings = np.append(points, point), np.append(headings, heading)
            leasts.append(least)
    made = LivingMap(encoder, frames, np.column_stack([points.real, points.imag]), headings)
    made.least = leasts
    return made


def examined(encoder: Encoder, world: RobotWorld, runs: int, seed: int) -> dict[str, Any]:
    """The figures of one world."""
    third = len(world.first) // GAP
    gap = GappedWorld(world, third, 2 * third)
    first = encoded(encoder, world.first, world.keypoints)
    before = gapped(encoder, gap, first, None, ())
    exam = encoded_run(encoder, world, RunPlan(EXAMINED, "day", "examiner"), seed)
    told: dict[str, Any] = {
        "places": len(before),
        "before": recognized(gap, before, exam),
        "wrong before": wrong_elsewhere(gap, before, exam),
    }
    found: list[dict[str, Any]] = []
    for number in range(runs):
        run = encoded_run(encoder, world, RunPlan(number, "day", "A"), seed)
        stretches, refused, graph = surveyed(before, run)
        one: dict[str, Any] = {"stretches": len(stretches), "refused": refused, "after": None}
        one |= {"errors": [], "turned": []}
        answers = before.recognize(run.frames)
        trail = Trail.of(run_frames(run, answers, graph))
        taken: list[Keyframe] = []
        for stretch in stretches:
            points, headings, errors, turned = errors_of(gap, before, run, stretch)
            one["errors"] += errors.tolist()
            one["turned"] += turned.tolist()
            one["misclosure"], one["length"] = stretch.misclosure, stretch.length
            one["spread"] = [frame.spread for frame in stretch.frames]
            for frame, point, heading in zip(stretch.frames, points, headings, strict=True):
                cohort = cohort_of(trail, frame.frame, graph)
                beside, far = (
                    before.scores_between(run.frames[frame.frame], [run.frames[at] for at in part.tolist()])
                    for part in (cohort.beside, cohort.far)
                )
                least = least_score(beside, far, encoder.calibration)
                if least is not None:
                    taken.append((frame.frame, point, heading, least))
        if taken:
            after = gapped(encoder, gap, first, run, taken)
            one["taken"] = len(taken)
            one["after"] = recognized(gap, after, exam)
            one["wrong after"] = wrong_elsewhere(gap, after, exam)
        print(world.name, number, {k: v for k, v in one.items() if k not in ("errors", "turned", "spread")}, flush=True)
        found.append(one)
    attacker = encoded_run(encoder, world, RunPlan(1000, "day", "stranger", (ATTACKER,)), seed)
    stretches, refused, _ = surveyed(before, attacker)
    told |= {"runs": found, "attacker": len(stretches), "attacker refused": refused}
    return told


def rows_of(name: str, told: dict[str, Any]) -> list[tuple[object, ...]]:
    """The row of a world."""
    runs = told["runs"]
    errors, turned = (np.array([one for run in runs for one in run[part]]) for part in ("errors", "turned"))
    right, wrong, frames = told["before"]
    after = [run["after"] or told["before"] for run in runs]
    now = [sum(part) for part in zip(*after, strict=True)]
    elsewhere = sum(run.get("wrong after", told["wrong before"]) for run in runs)
    return [
        (
            name,
            f"{sum(run['stretches'] for run in runs)}/{len(runs)}",
            len(errors),
            f"{np.median(errors):.2f}, {np.percentile(errors, 95):.2f}" if len(errors) else "",
            f"{np.median(turned):.1f}, {np.percentile(turned, 95):.1f}" if len(turned) else "",
            f"{right}/{frames} ({wrong})",
            f"{now[0]}/{now[2]} ({now[1]})",
            f"{told['wrong before'] * len(runs)}, {elsewhere}",
            told["attacker"],
        )
    ]


COLUMNS = ("", "stretches", "places", "metres", "degrees", "before", "after", "elsewhere wrong", "attacker's")
"""Stretches that were proposed, and runs; their places; the errors of their positions and headings, the median and the
95th percentile; of the frames of another run in the gap, those that are recognized rightly and, in brackets, wrongly,
before and after; frames outside the gap that are recognized wrongly, before and after, in all runs; and stretches that
the attacker's run proposes."""


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    worlds: Annotated[str, typer.Option(help="Names with commas.")] = ",".join(WORLDS),
    runs: Annotated[int, typer.Option(help="Runs that propose.")] = 4,
    seed: Annotated[int, typer.Option(help="Of the runs.")] = 0,
    encoder: Annotated[str, typer.Option(help="Name of the encoder.")] = DEFAULT_ENCODER,
) -> None:
    """Print a line for each run and a table, and store the figures."""
    chosen = EncoderCatalogue().get(encoder)
    told = {name: examined(chosen, WORLDS[name](datasets), runs, seed) for name in worlds.split(",")}
    rows = [row for name, one in told.items() for row in rows_of(name, one)]
    report("new-ground", f"{chosen.name}: a gap of a third of the map", COLUMNS, rows, {"worlds": told})


if __name__ == "__main__":
    typer.run(main)
