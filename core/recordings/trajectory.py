"""A trajectory: where a robot was at certain times, and by interpolation at the times between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.errors import InvalidTrajectory
from core.places import Pose
from core.recordings.frame import NANOSECONDS
from core.recordings.plausibility import BY_FAR, LARGEST_COORDINATE, MOST_SPEED, Source, judge

LEAST_HORIZONTAL = 1e-6
"""An axis that is so near the vertical points nowhere in the plane."""


@dataclass(frozen=True)
class Trajectory:
    """Samples of a path, in order of time, each time once.

    nanoseconds: int64 [n].
    positions: float64 [n, 3], metres, or latitude and longitude in degrees and the height above the ellipsoid, NaN if
        it is not known.
    turns: float64 [n, 4], unit quaternions x, y, z, w; NaN where the orientation is not known.
    geographic: whether positions are in degrees.
    part: int64 [n]; between samples of different parts there is no pose.
    """

    nanoseconds: NDArray[np.int64]
    positions: NDArray[np.float64]
    turns: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 4)))
    geographic: bool = False
    part: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    def __post_init__(self) -> None:
        if len(self.part) < len(self.nanoseconds):
            object.__setattr__(self, "part", np.zeros(len(self.nanoseconds), np.int64))

    @classmethod
    def of_samples(
        cls,
        nanoseconds: ArrayLike,
        positions: ArrayLike,
        turns: ArrayLike,
        geographic: bool = False,
        part: ArrayLike | None = None,
    ) -> Trajectory:
        """Samples in any order; of several at one time the first counts.

        Raises:
            InvalidTrajectory: there is no sample, or a position is not a finite number of at most 1e9.
        """
        times = np.asarray(nanoseconds, np.int64)
        places = np.asarray(positions, np.float64).reshape(-1, 3)
        if not len(times):
            raise InvalidTrajectory("The trajectory has no pose.")
        needed = places[:, :2] if geographic and np.isnan(places[:, 2]).any() else places
        if not (np.abs(needed) <= LARGEST_COORDINATE).all():
            raise InvalidTrajectory(f"The trajectory has a position beyond {LARGEST_COORDINATE:g} m, or none.")
        times, first = np.unique(times, return_index=True)
        parts = np.zeros(len(places), np.int64) if part is None else np.asarray(part, np.int64)
        return cls(times, places[first], np.asarray(turns, np.float64).reshape(-1, 4)[first], geographic, parts[first])

    def __len__(self) -> int:
        return len(self.nanoseconds)

    def at(self, nanoseconds: ArrayLike, largest_gap: float) -> list[Pose | None]:
        """The poses at some times: positions on the straight line between two samples, turns on the shortest arc.

        The heading is the direction of the x axis of the moving body, seen from above.

        Args:
            largest_gap: seconds; between samples further apart, and beyond the ends, there is no pose.
        """
        first, last, share, known = _around(self.nanoseconds, nanoseconds, largest_gap)
        if not len(self):
            return [None] * len(known)
        known &= self.part[first] == self.part[last]
        places = self._positions(first, last, share)
        headings = self._headings(first, last, share)
        return [
            self._pose(place, heading) if one else None
            for place, heading, one in zip(places, headings, known, strict=True)
        ]

    def _positions(
        self, first: NDArray[np.int64], last: NDArray[np.int64], share: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        steps = self.positions[last] - self.positions[first]
        if self.geographic:  # across the meridian of 180 degrees the short way round
            steps[:, 1] = (steps[:, 1] + 180) % 360 - 180
        places = self.positions[first] + share[:, None] * steps
        if self.geographic:
            places[:, 1] = (places[:, 1] + 180) % 360 - 180
        return places

    def _headings(
        self, first: NDArray[np.int64], last: NDArray[np.int64], share: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Degrees counter-clockwise from +x, [0, 360); NaN where an orientation is not known or points straight up."""
        from scipy.spatial.transform import Rotation

        headings = np.full(len(first), math.nan)
        known = np.isfinite(self.turns[first]).all(axis=1) & np.isfinite(self.turns[last]).all(axis=1)
        if not known.any():
            return headings
        begin, end = (Rotation.from_quat(self.turns[rows[known]]) for rows in (first, last))
        arc = (begin.inv() * end).as_rotvec()  # at most half a turn
        axes = (begin * Rotation.from_rotvec(share[known, None] * arc)).apply([1.0, 0.0, 0.0])
        found = np.degrees(np.arctan2(axes[:, 1], axes[:, 0])) % 360
        headings[known] = np.where(np.hypot(axes[:, 0], axes[:, 1]) < LEAST_HORIZONTAL, math.nan, found)
        return headings

    def _pose(self, place: NDArray[np.float64], heading: float) -> Pose:
        if self.geographic:
            height = None if math.isnan(place[2]) else float(place[2])
            return Pose(latitude=float(place[0]), longitude=float(place[1]), z=height)
        turn = None if math.isnan(heading) else float(heading)
        return Pose(x=float(place[0]), y=float(place[1]), z=float(place[2]), heading=turn)


def _around(
    samples: NDArray[np.int64], nanoseconds: ArrayLike, largest_gap: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """The samples before and after some times, by their numbers, how far between them, and whether a gap is bridged."""
    times = np.asarray(nanoseconds, np.int64)
    if not len(samples):
        none = np.zeros(len(times), np.int64)
        return none, none, none.astype(np.float64), none.astype(np.bool_)
    after = np.searchsorted(samples, times, side="left")
    inside = after < len(samples)
    exact = inside & (samples[np.minimum(after, len(samples) - 1)] == times)
    last = np.where(inside, after, len(samples) - 1)
    first = np.where(exact, last, np.maximum(last - 1, 0))
    gaps = samples[last] - samples[first]
    known = exact | (inside & (after > 0) & (gaps <= largest_gap * NANOSECONDS))
    return first, last, np.where(gaps > 0, (times - samples[first]) / np.maximum(gaps, 1), 0.0), known


@dataclass(frozen=True)
class JudgedTrajectory:
    """What of a trajectory can be believed.

    trajectory: the samples in one frame of coordinates; there may be none.
    local: the samples in all frames of coordinates, each in its own.
    told: int64 [m], the times of all samples, also those that are left out, in order.
    begins: int64 [k], the times at which coordinates begin anew.
    remarks: sentences about what is left out.
    """

    trajectory: Trajectory
    local: Trajectory
    told: NDArray[np.int64]
    begins: NDArray[np.int64]
    remarks: list[str]

    @classmethod
    def of_samples(
        cls,
        nanoseconds: ArrayLike,
        positions: ArrayLike,
        turns: ArrayLike,
        source: Source,
        geographic: bool = False,
        absolute: bool = False,
        most_speed: float = MOST_SPEED,
        publishers: ArrayLike | None = None,
    ) -> JudgedTrajectory:
        """Judge samples in any order, with arguments as of ``judge``.

        The first frame of coordinates counts, unless another one has by far more samples.
        """
        times = np.asarray(nanoseconds, np.int64)
        places = np.asarray(positions, np.float64).reshape(-1, 3)
        quaternions = np.asarray(turns, np.float64).reshape(-1, 4)
        found = judge(
            times,
            places,
            None if geographic else quaternions,
            source,
            geographic,
            absolute,
            most_speed,
            publishers=publishers,
        )
        order = np.argsort(times, kind="stable")
        held = order[found.kept[order]]
        segments = found.segment[held]
        begins = times[held[1:]][np.diff(segments) != 0]
        oriented = np.where(found.turned[:, None], quaternions, math.nan)

        def through(samples: NDArray[np.int64]) -> Trajectory:
            if not samples.size:
                return Trajectory(times[:0], places[:0], oriented[:0], geographic)
            return Trajectory.of_samples(
                times[samples], places[samples], oriented[samples], geographic, found.part[samples]
            )

        local = through(held)
        if begins.size:
            sizes = np.bincount(segments)
            largest = int(np.argmax(sizes))
            held = held[segments == (largest if sizes[largest] >= BY_FAR * sizes[segments[0]] else segments[0])]
        return cls(through(held) if begins.size else local, local, np.unique(times), begins, found.remarks)

    def covers(self, nanoseconds: ArrayLike, largest_gap: float) -> NDArray[np.bool_]:
        """Whether there would be poses at some times, bool, were all samples believed."""
        return _around(self.told, nanoseconds, largest_gap)[3]

    def span(self) -> str:
        """From when to when samples reach, in seconds, for messages."""
        return f"{self.told[0] / NANOSECONDS:.3f} s to {self.told[-1] / NANOSECONDS:.3f} s"
