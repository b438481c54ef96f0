"""A run of the robot: where it was, where the node said it was, and what that comes to."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from examples.simulator.world import Array
from placerec_ros.planar import Planar, map_to_odom

ORIGIN = Planar(0.0, 0.0, 0.0)
FOUND = 1.0
"""Metres by which the node's transform may be off for the robot to count as found."""
SLIDE = 0.1
"""Share of a step by which the transform may move the robot without a localization: odometry's scale is learned."""


@dataclass(frozen=True)
class Frame:
    """One picture of the run, and where the robot was when it took it.

    seconds: of the robot's own time.
    estimate: by the last transform of the node, None before the first one.
    filtered: the robot's pose by all answers up to this picture's, and the covariance of its x, y and yaw, [3, 3]; None
        if the node does not know it.
    localized: whether the node was localized by this very picture.
    carried: whether the robot has just been set down somewhere else.
    """

    seconds: float
    true: Planar
    odom: Planar
    estimate: Planar | None
    filtered: Planar | None
    covariance: Array | None
    verdict: str
    localized: bool
    carried: bool = False

    @property
    def error(self) -> float:
        """Metres from where the robot was to where the transform had it; infinite without one."""
        return math.inf if self.estimate is None else _metres(self.true, self.estimate)


@dataclass
class Run:
    """The frames of a run, and its end.

    bumps: steps in which a wall was in the way.
    """

    goal: tuple[float, float]
    frames: list[Frame] = field(default_factory=list)
    arrived: bool = False
    end: Planar = ORIGIN
    bumps: int = 0

    def figures(self) -> dict[str, Any]:
        """The figures of the run; all lengths in metres, NaN if there is nothing to measure.

        lost_frames, lost_metres: from where the robot was set down to where the transform was right again.
        error_median, error_most: of the transform, while the robot was not lost.
        within_3: share of filtered poses within three deviations, while it was not lost.
        jump_median, jump_most: by how much a localization has moved the robot, but for that by which it was found.
        jumps_without_evidence: how often it was moved by more than a share of its step, and no picture had said so.
        """
        lost = self._lost()
        way = [one for one, is_lost in zip(self.frames, lost, strict=True) if not is_lost and one.estimate is not None]
        astray = [pair for pair, is_lost in zip(pairwise(self.frames), lost, strict=False) if is_lost]
        jumps, unfounded = self._jumps(lost)
        within = [_deviations(one) <= 3 for one in way if one.filtered is not None]
        return {
            "frames": len(self.frames),
            "silent_frames": sum(one.estimate is None for one in self.frames),
            "lost_frames": sum(lost),
            "lost_metres": sum(_metres(before.true, after.true) for before, after in astray),
            "error_median": _median([one.error for one in way]),
            "error_most": max((one.error for one in way), default=math.nan),
            "within_3": float(np.mean(within)) if within else math.nan,
            "jump_median": _median(jumps),
            "jump_most": max(jumps, default=math.nan),
            "jumps_without_evidence": unfounded,
            "bumps": self.bumps,
            "arrived": self.arrived,
            "goal_error": math.hypot(self.end.x - self.goal[0], self.end.y - self.goal[1]),
        }

    def _lost(self) -> list[bool]:
        """For each frame whether the robot had been carried off and not been found since."""
        found, lost = [], False
        for frame in self.frames:
            lost = (lost or frame.carried) and frame.error > FOUND
            found.append(lost)
        return found

    def _jumps(self, lost: list[bool]) -> tuple[list[float], int]:
        """Metres by which each localization has moved the robot, and how often it was moved without one."""
        jumps, unfounded = [], 0
        for number, (before, after) in enumerate(pairwise(self.frames)):
            if before.estimate is None or after.estimate is None:
                continue
            now = map_to_odom(after.estimate, after.odom).then(before.odom)
            moved = _metres(before.estimate, now)
            if not before.localized:
                unfounded += moved > SLIDE * _metres(before.odom, after.odom) + 1e-3
            elif not (lost[number] and not lost[number + 1]):
                jumps.append(moved)
        return jumps, unfounded

    def write(self, path: Path) -> None:
        """Write all of it as JSON."""
        path.write_text(json.dumps(asdict(self) | {"figures": self.figures()}, default=np.ndarray.tolist))

    @classmethod
    def read(cls, path: Path) -> Run:
        """Read a run that was written."""
        found = json.loads(path.read_text())
        frames = [_frame(one) for one in found["frames"]]
        goal = (float(found["goal"][0]), float(found["goal"][1]))
        return cls(goal, frames, found["arrived"], Planar(**found["end"]), found["bumps"])

    def summary(self) -> Iterator[str]:
        """The run in sentences."""
        one = self.figures()
        yield (
            f"The robot drove {self.frames[-1].seconds:.0f} s and took {one['frames']} pictures. "
            f"It knew where it was after {one['silent_frames']}."
        )
        yield (
            f"While it was not lost, the node had it within {one['error_most']:.2f} m "
            f"(median {one['error_median']:.2f} m)."
        )
        if any(frame.carried for frame in self.frames):
            yield (f"It was carried off, and found after {one['lost_frames']} pictures and {one['lost_metres']:.1f} m.")
        end = f"has arrived, {one['goal_error']:.2f} m from its goal" if self.arrived else "has not arrived"
        yield f"It {end}, and bumped into walls {self.bumps} times."


def _frame(found: dict[str, Any]) -> Frame:
    poses = {
        name: None if found[name] is None else Planar(**found[name])
        for name in ("true", "odom", "estimate", "filtered")
    }
    covariance = None if found["covariance"] is None else np.array(found["covariance"])
    return Frame(**(found | poses | {"covariance": covariance}))


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else math.nan


def _metres(one: Planar, other: Planar) -> float:
    return math.hypot(one.x - other.x, one.y - other.y)


def _deviations(frame: Frame) -> float:
    """How many standard deviations the filtered position is off."""
    assert frame.filtered is not None and frame.covariance is not None
    off = np.array([frame.filtered.x - frame.true.x, frame.filtered.y - frame.true.y])
    return math.sqrt(float(off @ np.linalg.solve(frame.covariance[:2, :2], off)))
