"""The frames of a whole run, as they were judged one by one, and the way that odometry says the robot went."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from core.belief import (
    NOTHING,
    Evidence,
    Odometry,
    OdometryPose,
    PlaceGraph,
    Sight,
    Step,
    Stride,
    freshness,
    motion_between,
)
from core.geometry.keypoints import Keypoints
from core.judgement.verdict import Verdict
from core.learning.smoothing import WeighedFrame


@dataclass(frozen=True, eq=False)
class RunFrame:
    """One frame of a run, as it was judged alone.

    seen: its evidence.
    verdict, probability: of its own judgement; the latter is None where its calibration knows none.
    row: of the best match; None without one.
    pose: where odometry said that the robot was; None: it said nothing.
    sight: why the frame does not count: it shows hardly anything, or what the frame before showed; None if it does.
    keypoints: of the frame; None: it has none.
    """

    seen: Evidence
    verdict: Verdict
    probability: float | None
    row: int | None
    pose: OdometryPose | None = None
    sight: Sight | None = None
    keypoints: Keypoints | None = None


@dataclass(frozen=True, eq=False)
class Trail:
    """The way of a run of n frames by its odometry.

    motions: from the frame before to each; None where it is not known, as for the first frame.
    """

    frames: Sequence[RunFrame]
    motions: Sequence[Odometry | None]

    @classmethod
    def of(cls, frames: Sequence[RunFrame]) -> Trail:
        """The trail of a run."""
        motions: list[Odometry | None] = [None] * len(frames)
        for number in range(1, len(frames)):
            before, now = frames[number - 1].pose, frames[number].pose
            motions[number] = None if now is None else motion_between(before, now, None)
        return cls(frames, motions)

    @cached_property
    def travelled(self) -> NDArray[np.float64]:
        """Metres that the robot has gone since the first frame, float64 [n]; unknown motions add nothing."""
        gone = [0.0 if motion is None else motion.distance for motion in self.motions]
        return np.cumsum(gone, dtype=np.float64)

    @cached_property
    def piece(self) -> NDArray[np.int64]:
        """A number for each stretch in which all motions are known, int64 [n]."""
        begins = [motion is None for motion in self.motions]
        return np.cumsum(begins)

    @cached_property
    def points(self) -> NDArray[np.complex128]:
        """Where odometry had the robot, x + iy in metres, complex128 [n]; comparable within a piece."""
        return np.array([complex(0, 0) if one.pose is None else complex(one.pose.x, one.pose.y) for one in self.frames])

    @cached_property
    def headings(self) -> NDArray[np.float64]:
        """Radians counter-clockwise from the first coordinate of the odometry, float64 [n]; NaN where not known."""
        return np.array([math.nan if one.pose is None else one.pose.heading for one in self.frames])

    def looks(self, graph: PlaceGraph, pace: float | None = None) -> list[WeighedFrame]:
        """The frames for the smoother.

        Args:
            pace: frames of the map in a metre, along its sequences; None: not known.
        """
        return [self._look(number, graph, pace) for number in range(len(self.frames))]

    def _look(self, number: int, graph: PlaceGraph, pace: float | None) -> WeighedFrame:
        frame, motion = self.frames[number], self.motions[number]
        step = Step(odometry=motion)
        stride = None if pace is None or motion is None else Stride(pace * motion.distance)
        if frame.sight == "covered":
            return WeighedFrame(NOTHING, step, 1.0, stride)
        share = 0.0 if frame.sight == "constant" else freshness(motion, graph.spacing)
        return WeighedFrame(frame.seen, step, share, stride)
