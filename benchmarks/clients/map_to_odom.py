"""The transform from the map to the odometry as the ROS 2 node sends it: how it jumps, how far off it is, and is said.

    python -m benchmarks.clients.map_to_odom --datasets ../shared/datasets
    python -m benchmarks.clients.map_to_odom --recorded     # the answers that the tests have

A robot drives along corridor and lip6_outdoor, on made-up poses and with odometry that drifts
(benchmarks/clients/drives.py).  Its frames are asked in a session of a service, with odometry, and the answers go the
way of the node.  A jump is how far a new transform moves the robot at the moment at which it comes.  The filter is
compared with each answer by itself (single), which a node without a filter sends, and with answers of which every tenth
is wrong: a pose elsewhere on the drive.  A jump without evidence is one in a frame without a localization by more than
the error that odometry's scale can have.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.clients.drives import FOLDERS, DriveFrame, answered, read, write
from benchmarks.report import report, verdict
from placerec_ros.fusion import Fix, Fusion
from placerec_ros.parameters import PARAMETERS
from placerec_ros.planar import Planar, map_to_odom, wrapped
from placerec_ros.pose import PoseEstimate

RECORDED = Path(__file__).parents[2] / "tests" / "clients" / "ros2" / "navigation" / "drives"
MEDIAN, MOST, WITHIN = 0.15, 0.5, 0.99
"""The bars: metres of a jump, its median and its 95th percentile, and the share of errors within three deviations."""
SHOWN = (
    *("jump_median", "jump_p95", "jump_most", "error_median", "error_p95"),
    *("within_3_position", "within_3_heading"),
)
"""The figures of the table; the JSON has all."""
SLIDE = 0.1
"""Share of a step by which the transform may move without a localization: the scale of odometry is known to so much."""
LIMITS = [float(one.default) for one in PARAMETERS if one.name in ("position_limit", "heading_limit")]


@dataclass
class Course:
    """The course of the transform as a robot sees it, in metres.

    jumps, slides: how far each frame moved the robot, if it was localized in it, and if not.
    steps: the steps of the slides.
    errors: of the position, while the transform was sent.
    far, turned: the normalized errors of position and heading.
    silent: frames before the transform was sent first, of all drives.
    """

    jumps: list[float] = field(default_factory=list)
    slides: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    far: list[float] = field(default_factory=list)
    turned: list[float] = field(default_factory=list)
    silent: int = 0

    def note_move(self, before: Planar, now: Planar, frame: DriveFrame, step: float) -> None:
        """Note by how much a new transform moves the robot."""
        first, second = before.then(frame.odom), now.then(frame.odom)
        moved = math.hypot(first.x - second.x, first.y - second.y)
        if frame.found is not None:
            self.jumps.append(moved)
        else:
            self.slides.append(moved)
            self.steps.append(step)

    def note_error(self, robot: Planar, covariance: Any, true: Planar) -> None:
        """Note how far the robot is from where it is said to be, with the covariance of x, y and yaw, [3, 3]."""
        off = np.array([robot.x - true.x, robot.y - true.y])
        self.errors.append(float(np.hypot(*off)))
        self.far.append(math.sqrt(float(off @ np.linalg.solve(covariance[:2, :2], off))))
        self.turned.append(abs(wrapped(robot.yaw - true.yaw)) / math.sqrt(covariance[2, 2]))

    def figures(self) -> dict[str, float]:
        """The figures of the table."""
        shares = np.array(self.slides) / np.maximum(self.steps, 1e-3) if self.slides else np.zeros(1)
        return {
            "jump_median": float(np.median(self.jumps)),
            "jump_p95": float(np.percentile(self.jumps, 95)),
            "jump_most": float(np.max(self.jumps)),
            "jumps_without_evidence": int((shares > SLIDE).sum()),
            "error_median": float(np.median(self.errors)),
            "error_p95": float(np.percentile(self.errors, 95)),
            "within_3_position": float(np.mean(np.array(self.far) <= 3)),
            "within_3_heading": float(np.mean(np.array(self.turned) <= 3)),
            "silent": float(self.silent),
        }


def filtered(drive: Sequence[DriveFrame], course: Course) -> Course:
    """The course of the node's filter."""
    fusion, sent, started = Fusion(), False, False
    before: Fix | None = None
    for number, frame in enumerate(drive):  # an image a second
        fix = fusion.add(frame.odom, "start", frame.found, float(number))
        sent = fix is not None and fix.is_within(*LIMITS)
        started = started or sent
        course.silent += not started
        if sent and fix is not None:
            if before is not None:
                step = before.odom.inverse().then(frame.odom)
                course.note_move(before.correction, fix.correction, frame, math.hypot(step.x, step.y))
            course.note_error(fix.track.robot, fix.track.covariance, frame.true)
        before = fix if sent else None
    return course


def by_itself(drive: Sequence[DriveFrame], course: Course) -> Course:
    """The course of a transform that each localization sets anew."""
    before: Planar | None = None
    for frame in drive:
        if frame.found is None:
            course.silent += before is None
            continue
        now = map_to_odom(frame.found.planar, frame.odom)
        if before is not None:
            course.note_move(before, now, frame, 0.0)
        covariance = np.reshape(frame.found.covariance, (6, 6))[np.ix_((0, 1, 5), (0, 1, 5))]
        course.note_error(frame.found.planar, covariance, frame.true)
        before = now
    return course


def with_wrong_ones(drive: Sequence[DriveFrame], every: int = 10) -> list[DriveFrame]:
    """The drive with each so-many-th localization replaced by a sure one of a place elsewhere on the drive."""
    changed = list(drive)
    for number in range(every, len(drive), every):
        if (found := drive[number].found) is not None:
            elsewhere = drive[(number + len(drive) // 2) % len(drive)].true
            changed[number] = replace(changed[number], found=PoseEstimate(elsewhere, found.covariance, found.source))
    return changed


KINDS: dict[str, Callable[[Sequence[DriveFrame], Course], Course]] = {
    "single": by_itself,
    "filtered": filtered,
    "tenth wrong": lambda drive, course: filtered(with_wrong_ones(drive), course),
}


def measured(drives: dict[str, list[list[DriveFrame]]]) -> dict[str, dict[str, dict[str, float]]]:
    """The figures of each data set, of all its drives together, by the kind of transform."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for name, several in drives.items():
        for kind, follow in KINDS.items():
            course = Course()
            for drive in several:
                follow(drive, course)
            found.setdefault(name, {})[kind] = course.figures()
    return found


def show(figures: dict[str, dict[str, dict[str, float]]], drives: dict[str, list[list[DriveFrame]]]) -> None:
    """Print the table and write the JSON."""
    rows = []
    for name, kinds in figures.items():
        for kind, one in kinds.items():
            values = [f"{one[key]:.3f}" if key.startswith("within") else one[key] for key in SHOWN]
            rows.append((f"{name}, {kind}", *values))
    columns = ("", "jump", "95 %", "most", "error", "95 %", "3 sd", "heading")
    counted = {name: {"drives": len(several), "frames": len(several[0])} for name, several in drives.items()}
    title = "The transform from the map to the odometry, metres"
    report("map-to-odom", title, columns, rows, {"drives": counted, "figures": figures})
    for name, kinds in figures.items():
        print(f"{name}: {'; '.join(bars(kinds['filtered']))}")


def bars(one: dict[str, float]) -> tuple[str, ...]:
    """The bars, and whether the figures of a course meet them."""
    within = min(one["within_3_position"], one["within_3_heading"])
    return (
        f"jump, median {verdict(one['jump_median'], MEDIAN)}",
        f"95 % {verdict(one['jump_p95'], MOST)}",
        f"without evidence {verdict(one['jumps_without_evidence'], 0)}",
        f"within three deviations {verdict(within, WITHIN, at_least=True)}",
    )


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    seeds: Annotated[int, typer.Option(min=1, help="Drives along each, each with another odometry.")] = 3,
    recorded: Annotated[bool, typer.Option("--recorded", help="Take the answers that the tests have.")] = False,
    record: Annotated[bool, typer.Option("--record", help="Write the first drives where the tests read them.")] = False,
) -> None:
    """Drive and measure."""
    drives: dict[str, list[list[DriveFrame]]] = {}
    if recorded:
        drives = {name: [read(RECORDED / f"{name}.csv")] for name in FOLDERS}
    else:
        with tempfile.TemporaryDirectory() as folder:
            for name in FOLDERS:
                asked = answered(name, datasets / "eval", Path(folder), range(1, seeds + 1))
                drives[name] = [drive for _, drive in asked]
    if record:
        for name, several in drives.items():
            write(RECORDED / f"{name}.csv", several[0])
    show(measured(drives), drives)


if __name__ == "__main__":
    typer.run(main)
