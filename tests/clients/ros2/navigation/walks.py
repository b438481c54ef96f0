"""Simulated walks for the filter: true poses, odometry that is sound or fails, and localizations, some of them wrong.

A robot walks at 1.2 m/s for 150 s, with bends and stops. Odometry comes ten times a second, with errors of 5 % that
last and others that do not. Images come every second: 85 in 100 are localized, 3 in 100 elsewhere on the walk. Half of
the variance of a localization's error is alike for 30 m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from placerec_ros.fusion import Fusion
from placerec_ros.planar import Planar, wrapped
from placerec_ros.pose import UNKNOWN_ANGLE, PoseEstimate

RATE, SECONDS, SPEED = 10, 150, 1.2
"""Messages of odometry a second, the length of a walk, and metres a second."""
DEVIATION, HEADING = 1.0, math.radians(10)
"""Standard deviations of a localization; it states 20° of the heading, as places do."""
LOCALIZED, WRONG = 0.85, 0.03
FAULTS = ("frozen", "scale 0.3", "scale 3", "turned 180", "turned 90", "radians for degrees", "degrees for radians")


@dataclass(frozen=True)
class Share:
    """What the filter published along walks.

    within, turned: the shares of poses whose position, and heading, are within three deviations.
    error, deviation: medians in metres.
    sent: the share of poses within the limits of the transform.
    """

    within: float
    turned: float
    error: float
    deviation: float
    sent: float


def walk(random: np.random.Generator) -> list[Planar]:
    """The true poses of a walk."""
    poses, turn, bend, stop = [Planar(0.0, 0.0, float(random.uniform(-3, 3)))], 0.0, 0, 0
    for tick in range(SECONDS * RATE):
        if tick % RATE == 0:
            bend, stop = bend - 1, stop - 1
            if bend <= 0:
                turn = float(random.normal(0, math.radians(2)))
            if bend <= 0 and random.random() < 0.08:
                bend, turn = 3, float(random.choice((-1, 1))) * math.radians(25)
            if stop <= 0 and random.random() < 0.02:
                stop = 5
        moves = 0.0 if stop > 0 else 1.0
        poses.append(poses[-1].then(Planar(moves * SPEED / RATE, 0.0, moves * turn / RATE)))
    return poses


def odometry(true: list[Planar], fault: str, begin: int, random: np.random.Generator) -> list[Planar]:
    """The poses by odometry, which has a fault from a pose on; an empty one: none."""
    longer, more = 1 + 0.05 * random.choice((-1, 1), size=2)
    poses = [Planar(0.0, 0.0, float(random.uniform(-3, 3)))]
    for before, after in pairwise(true):
        step = before.inverse().then(after)
        length, noise = math.hypot(step.x, step.y), random.normal(size=3)
        factor = longer + 0.05 * noise[0]
        turn = step.yaw * (more + 0.05 * noise[1]) + math.radians(0.3) * math.sqrt(length) * noise[2]
        poses.append(poses[-1].then(Planar(factor * step.x, factor * step.y, wrapped(float(turn)))))
    return poses[:begin] + [faulty(pose, fault, poses[begin]) for pose in poses[begin:]]


def faulty(pose: Planar, fault: str, first: Planar) -> Planar:
    """A pose as odometry with a fault has it, whose first one this is."""
    kind, _, number = fault.partition(" ")
    if kind == "frozen":
        return first
    if kind == "scale":
        scale = float(number)
        return Planar(first.x + scale * (pose.x - first.x), first.y + scale * (pose.y - first.y), pose.yaw)
    if kind == "turned":
        return Planar(pose.x, pose.y, wrapped(pose.yaw + math.radians(float(number))))
    if kind == "radians":
        return Planar(pose.x, pose.y, math.radians(pose.yaw))
    return Planar(pose.x, pose.y, wrapped(math.degrees(pose.yaw))) if kind == "degrees" else pose


def localizations(true: list[Planar], random: np.random.Generator) -> list[PoseEstimate | None]:
    """A localization of each second, None where there is none."""
    found: list[PoseEstimate | None] = []
    stated = np.diag([DEVIATION**2, DEVIATION**2, 1e6, UNKNOWN_ANGLE, UNKNOWN_ANGLE, math.radians(20) ** 2])
    common, before = random.normal(size=3), true[0]
    for pose in true[::RATE]:
        step = before.inverse().then(pose)
        fading = math.exp(-math.hypot(step.x, step.y) / 30 - abs(step.yaw) / math.radians(90))
        common = fading * common + math.sqrt(1 - fading**2) * random.normal(size=3)
        x, y, yaw = math.sqrt(0.5) * (common + random.normal(size=3)) * (DEVIATION, DEVIATION, HEADING)
        at, luck = Planar(pose.x + x, pose.y + y, wrapped(pose.yaw + yaw)), random.random()
        if luck < WRONG:
            at = true[int(random.integers(len(true)))]
        found.append(PoseEstimate(at, tuple(stated.ravel().tolist()), "frame") if luck < LOCALIZED else None)
        before = pose
    return found


def along(fault: str, begin: float, seeds: range) -> Share:
    """What the filter publishes along walks, of which odometry has a fault after a share of the time."""
    rows: list[tuple[float, float, float, bool]] = []
    for seed in seeds:
        random = np.random.default_rng(seed)
        true = walk(random)
        odom = odometry(true, fault, int(begin * len(true)), random)
        fusion = Fusion()
        for second, found in enumerate(localizations(true, random)):
            fix = fusion.add(odom[second * RATE], "start", found, float(second))
            if fix is None:
                continue
            robot, real, (position, heading) = fix.track.robot, true[second * RATE], fix.deviations
            error = math.hypot(robot.x - real.x, robot.y - real.y)
            turned = abs(wrapped(robot.yaw - real.yaw)) / heading
            rows.append((error, position, turned, fix.is_within(3.0, 20.0)))
    table: NDArray[np.float64] = np.array(rows, np.float64)
    errors, deviations, turns, sent = table.T
    within, turned = float(np.mean(errors <= 3 * deviations)), float(np.mean(turns <= 3))
    return Share(within, turned, float(np.median(errors)), float(np.median(deviations)), float(np.mean(sent)))


def main() -> None:
    """Print the shares of all faults."""
    for fault, begin in [("", 0.0), *((fault, begin) for fault in FAULTS for begin in (0.0, 0.4))]:
        print(f"{fault or 'sound':20} from {begin:.1f}", along(fault, begin, range(1, 21)))


if __name__ == "__main__":
    main()
