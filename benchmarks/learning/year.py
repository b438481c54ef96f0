"""A year of runs through a world: where the robot truly was at each frame, and where its odometry says that it was."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.day.pictures import another_look
from benchmarks.learning.conditions import CONDITIONS
from benchmarks.learning.worlds import RobotWorld
from core.belief import OdometryPose
from core.frames.preprocessing import Pixels

BEND, BEND_METRES = 0.6, 40.0
"""The way winds: its heading is BEND · sin(metres / BEND_METRES), in radians."""

DRIFT = 0.05
"""Standard deviation of odometry as a share of the distance, both of a whole run and of each step."""

TURN_DRIFT = 0.01
"""Standard deviation of its heading after one metre, radians; it grows with the root of the way."""

STOOD, DETOUR, ASIDE = 12, 10, 15.0
"""Frames of a robot that stands; of one on a detour; and how many metres aside a detour leads."""

ATTACKER = "attacker"


class RunMoment(NamedTuple):
    """One frame of a run.

    at: the number of the later picture of the world that it shows; None: it shows something that the map does not have.
    pixels: of the picture.
    pose: by odometry.
    """

    at: int | None
    pixels: Pixels
    pose: OdometryPose


@dataclass(frozen=True)
class RunPlan:
    """One run of the year.

    number: of the run; robot: that makes it.
    events: any of "detour", "kidnapped", "stands", and ATTACKER, whose frames are all of elsewhere.
    """

    number: int
    condition: str
    robot: str
    events: tuple[str, ...] = ()


def year(world: RobotWorld, runs: int) -> list[RunPlan]:
    """The runs of a year: conditions in turn, of two robots, with what happens to robots; and an attacker in spring."""
    events = {
        1: ("stands",),
        2: ("detour",),
        4: ("kidnapped",),
        5: ("stands", "detour"),
        8: ("detour",),
        10: ("stands",),
    }
    order = world.conditions[1:] + world.conditions
    plans = []
    for number in range(runs):
        if number == min(4, runs - 1):
            plans.append(RunPlan(1000 + number, order[number % len(order)], "stranger", (ATTACKER,)))
        plans.append(RunPlan(number, order[number % len(order)], "AB"[number // 2 % 2], events.get(number, ())))
    return plans


def curve(metres: NDArray[np.floating]) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Where the way is at some metres, x + iy, complex128 [n], and its heading there, float64 [n]."""
    along = np.arange(-50, float(metres.max(initial=0)) + 50, 0.05)
    points = np.cumsum(0.05 * np.exp(1j * BEND * np.sin(along / BEND_METRES)))
    x, y = (np.interp(metres, along, part) for part in (points.real, points.imag))
    return x + 1j * y, BEND * np.sin(metres / BEND_METRES)


def _route(
    world: RobotWorld, plan: RunPlan, random: np.random.Generator
) -> Iterator[tuple[int | None, complex, float]]:
    """Where the robot truly goes: the picture, its pose as odometry without error would have it."""
    points, headings = curve(world.metres)
    count = len(points)
    third = count // 3
    stand, aside, carried = (int(random.integers(low, low + third // 2)) for low in (third // 2, third, 2 * third))
    turned, moved = 1.0 + 0j, 0j  # how the frame of odometry lies on the way, since the robot was carried

    def seen(at: int) -> tuple[complex, float]:
        shake = complex(*random.normal(0, 0.15, 2))
        return turned * (points[at] + shake) + moved, float(headings[at] + np.angle(turned))

    at = 0
    while at < count:
        yield at, *seen(at)
        if at == stand and "stands" in plan.events:
            point, heading = seen(at)
            for _ in range(STOOD):
                yield at, point, heading
        if at == aside and "detour" in plan.events:
            here, heading = seen(at)
            for step in range(1, DETOUR + 1):
                away = ASIDE * math.sin(math.pi * step / (DETOUR + 1))
                yield None, here + 1j * away * complex(math.cos(heading), math.sin(heading)), heading
        if at == carried and "kidnapped" in plan.events:
            # To a third of the way back, without odometry noticing anything.
            here, heading = seen(at)
            at = carried - third
            turned = complex(np.exp(1j * (heading - headings[at])))
            moved = here + 2 * complex(math.cos(heading), math.sin(heading)) - turned * points[at]
            plan = RunPlan(plan.number, plan.condition, plan.robot)
        at += 1


def moments(world: RobotWorld, plan: RunPlan, seed: int = 0) -> list[RunMoment]:
    """The frames of a run, in their order."""
    random = np.random.default_rng((seed, 20, plan.number))
    attacks = ATTACKER in plan.events
    scale = 1 + DRIFT * random.normal()
    found: list[RunMoment] = []
    before: tuple[complex, float] | None = None
    odometry, heading = 0j, 0.0
    first = int(random.integers(len(world.strangers)))
    for number, (at, point, direction) in enumerate(_route(world, plan, random)):
        if before is not None:
            step, turn = point - before[0], math.remainder(direction - before[1], 2 * math.pi)
            gone = step * np.exp(-1j * before[1]) * scale * (1 + DRIFT * random.normal())
            odometry += gone * np.exp(1j * heading)
            heading += turn + TURN_DRIFT * math.sqrt(abs(step)) * random.normal()
        before = point, direction
        if at is None or attacks:
            pixels = _stranger(world, plan, first + number)
        else:
            pixels = world.later(at, plan.condition, plan.number)
            if found and found[-1].at == at:
                pixels = another_look(found[-1].pixels, random)
        pose = OdometryPose(float(odometry.real), float(odometry.imag), heading, origin=str(plan.number))
        found.append(RunMoment(None if attacks else at, pixels, pose))
    return found


def _stranger(world: RobotWorld, plan: RunPlan, number: int) -> Pixels:
    """A picture of elsewhere, in the condition of the run."""
    pixels = world.strangers[number % len(world.strangers)]
    height, width = world.first[0].shape[:2]
    if pixels.shape[:2] != (height, width):
        pixels = np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    kind = plan.condition if plan.condition in CONDITIONS else ("night" if "night" in plan.condition else "day")
    return CONDITIONS[kind](pixels, 5000 + number, plan.number)
