"""The tree of a recording's transforms over time (TF), and the path of one of its frames in another."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidTrajectory
from core.recordings.frame import NANOSECONDS
from core.recordings.messages import Transform
from core.recordings.plausibility import LARGEST_COORDINATE, MOST_SPEED, Source, smooth_parts
from core.recordings.trajectory import JudgedTrajectory

FIXED = ("map", "odom")
"""The frames in which poses are, if none is named: the first of these that there is."""
ABSOLUTE = ("map", "world", "earth", "ecef", "utm", "enu", "ned", "global")
"""Frames that are fixed to the world: where a pose in one of them jumps, it is corrected.  In others, such as odom, it
begins anew."""
MOST_LISTED = 20
"""Frames that a message of an error lists."""

OPTICAL = (0.5, -0.5, 0.5, 0.5)
"""The turn x, y, z, w from a camera's optical frame (z ahead, x to the right) to that of a body (x ahead, z up)."""


def is_absolute(frame: str) -> bool:
    """Whether a frame, by its name, is fixed to the world."""
    return frame.rpartition("/")[2] in ABSOLUTE


@dataclass
class Edge:
    """The poses of a frame in its parent, by time."""

    parent: str
    nanoseconds: list[int] = field(default_factory=list)
    moved: list[NDArray[np.float64]] = field(default_factory=list)
    turned: list[NDArray[np.float64]] = field(default_factory=list)

    def path(self, most_speed: float) -> Path:
        """The edge with its poses in the order of their times, each time once."""
        times, first = np.unique(np.array(self.nanoseconds, np.int64), return_index=True)
        moved, turned = np.array(self.moved)[first], np.array(self.turned)[first]
        return Path(times, moved, turned, smooth_parts(times, moved, turned, most_speed))


@dataclass(frozen=True)
class Path:
    """Poses at n times: int64 [n], metres float64 [n, 3], unit quaternions x, y, z, w float64 [n, 4].

    With one time it is the pose at any.  Between two ``parts``, int64 [n], there is none.
    """

    nanoseconds: NDArray[np.int64]
    moved: NDArray[np.float64]
    turned: NDArray[np.float64]
    parts: NDArray[np.int64]

    def knows(self, times: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether there is a pose at times between the first and the last."""
        first, last = self._around(times)
        found: NDArray[np.bool_] = self.parts[first] == self.parts[last]
        return found

    def _around(self, times: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The poses before and after times, by their numbers; twice the same one at its own time."""
        last = np.clip(np.searchsorted(self.nanoseconds, times), 0, len(self.nanoseconds) - 1)
        return np.maximum(last - (self.nanoseconds[last] > times), 0), last

    def at(self, times: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions [m, 3] and turns [m, 4] at times between the first and the last: straight lines, shortest arcs."""
        from scipy.spatial.transform import Rotation

        first, last = self._around(times)
        gaps = self.nanoseconds[last] - self.nanoseconds[first]
        share = (times - self.nanoseconds[first]) * (gaps > 0) / np.maximum(gaps, 1)
        begin, end = Rotation.from_quat(self.turned[first]), Rotation.from_quat(self.turned[last])
        turned = begin * Rotation.from_rotvec(share[:, None] * (begin.inv() * end).as_rotvec())
        return self.moved[first] + share[:, None] * (self.moved[last] - self.moved[first]), turned.as_quat()


class TransformTree:
    """The transforms of a recording.

    ``/tf_static`` and ``/tf`` are treated alike: a frame whose pose came once has it all the time.
    """

    def __init__(self) -> None:
        self._edges: dict[str, Edge] = {}
        self._unusable: dict[str, list[int]] = {}
        """The times of transforms whose numbers are none, by the frame."""

    def add(self, found: Iterable[Transform], received: int) -> None:
        """Take in the transforms of a message; ``received``: when, for those without a stamp.

        If a frame gets another parent, the last one counts.
        """
        for one in found:
            edge = self._edges.get(one.child)
            if edge is None or edge.parent != one.parent:
                edge = self._edges[one.child] = Edge(one.parent)
            if not (np.abs(one.moved) <= LARGEST_COORDINATE).all() or not np.isfinite(one.turned).all():
                self._unusable.setdefault(one.child, []).append(one.stamp or received)
                continue
            edge.nanoseconds.append(one.stamp or received)
            edge.moved.append(one.moved)
            edge.turned.append(one.turned)

    @property
    def frames(self) -> set[str]:
        """All frames."""
        return {*self._edges, *(edge.parent for edge in self._edges.values())}

    def trajectory(
        self, fixed: str | None, moving: str, name: str = "/tf", most_speed: float = MOST_SPEED
    ) -> JudgedTrajectory:
        """The poses of a frame in another one, at the times at which any transform between them came.

        The x axis of an optical frame is that of the body: where the camera looks.

        Args:
            fixed: None: the first of ``FIXED`` that there is.
            name: of the topic, for remarks.
            most_speed: metres a second; no vehicle is faster.

        Raises:
            InvalidTrajectory: there is no such frame, or no transforms lead from one to the other at any time.
        """
        from scipy.spatial.transform import Rotation

        fixed = fixed or next((one for one in FIXED if one in self.frames), FIXED[0])
        for frame in (fixed, moving):
            if frame not in self.frames:
                raise InvalidTrajectory(f"There is no transform of a frame {frame!r}. There are: {self._listed()}.")
        down, up = self._between(fixed, moving)
        remarks = [self._unusable_of(one, name) for one in (*down, *up) if one in self._unusable]
        for one in (*down, *up):
            if not self._edges[one].nanoseconds:
                raise InvalidTrajectory(f"There is no usable transform of {one!r}: {remarks[0]}")
        paths = {one: self._edges[one].path(most_speed) for one in (*down, *up)}
        told = self._times(fixed, moving, list(paths.values()))
        times = told[np.logical_and.reduce([path.knows(told) for path in paths.values()])]
        moved, turned = np.zeros((len(times), 3)), Rotation.identity(len(times))
        for one, inverted in [*((one, True) for one in down), *((one, False) for one in reversed(up))]:
            step, quaternions = paths[one].at(times)
            turn = Rotation.from_quat(quaternions)
            if inverted:
                turn = turn.inv()
                step = -turn.apply(step)
            moved, turned = moved + turned.apply(step), turned * turn
        if moving.endswith(("optical", "optical_frame")):
            turned = turned * Rotation.from_quat(OPTICAL)
        corrected = is_absolute(fixed) and bool(up) and len(paths[up[-1]].nanoseconds) > 1
        source = Source(f"{name} ({moving} in {fixed})", "poses")
        found = JudgedTrajectory.of_samples(
            times, moved, turned.as_quat(), source, absolute=corrected, most_speed=most_speed
        )
        return replace(found, told=told, remarks=remarks + found.remarks)

    def _unusable_of(self, child: str, name: str) -> str:
        """A sentence on the transforms of a frame whose numbers are none."""
        times, edge = self._unusable[child], self._edges[child]
        return (
            f"{len(times)} of {len(times) + len(edge.nanoseconds)} transforms of {name} from {edge.parent} to {child} "
            f"have a number that is none, or a position beyond {LARGEST_COORDINATE:g} m (first at "
            f"{min(times) / NANOSECONDS:.3f} s): they are left out."
        )

    def _listed(self) -> str:
        frames = sorted(self.frames)
        return ", ".join(frames[:MOST_LISTED]) + (", …" if len(frames) > MOST_LISTED else "") if frames else "none"

    def _between(self, fixed: str, moving: str) -> tuple[list[str], list[str]]:
        """The frames from ``fixed`` up to the first one above both, and those from ``moving`` up to it."""
        first, second = self._to_root(fixed), self._to_root(moving)
        shared = next((name for name in second if name in first), None)
        if shared is None:
            raise InvalidTrajectory(f"No transforms lead from {fixed!r} to {moving!r}. There are: {self._listed()}.")
        return first[: first.index(shared)], second[: second.index(shared)]

    def _to_root(self, frame: str) -> list[str]:
        """A frame and all above it; frames in a circle have no root, so it ends where the circle closes."""
        found = [frame]
        while frame in self._edges and self._edges[frame].parent not in found:
            frame = self._edges[frame].parent
            found.append(frame)
        return found

    @staticmethod
    def _times(fixed: str, moving: str, paths: list[Path]) -> NDArray[np.int64]:
        """The times of all paths that are within those of each."""
        changing = [path.nanoseconds for path in paths if len(path.nanoseconds) > 1]
        if not changing:
            raise InvalidTrajectory(f"{moving!r} never moves in {fixed!r}: all transforms between them came once.")
        begin, end = max(times[0] for times in changing), min(times[-1] for times in changing)
        times = np.unique(np.concatenate(changing))
        found: NDArray[np.int64] = times[(times >= begin) & (times <= end)]
        if not len(found):
            raise InvalidTrajectory(f"The transforms from {fixed!r} to {moving!r} have no time in common.")
        return found
