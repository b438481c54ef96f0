"""Keyframes: the frames of a recording that show something new, by distance, angle, time or change of descriptor.

Without any choice of them, the frames in which nothing changes at all are separated from the others by :func:`moving`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from core.places import Pose
from core.recordings.frame import NANOSECONDS, RecordedFrame

Describe = Callable[[RecordedFrame], NDArray[np.float32] | None]
"""Gives the descriptor of a frame, float32 [D], of length 1; None if it has none."""


STOP_METRES = 1.0
"""Metres: a robot whose poses are farther apart, and by more than their noise, has moved, with any view."""

NOISE = 8.0
"""Poses of one place are hardly ever farther apart than this many times their noise.  Of a stop of 300 frames, 1 is
retained, and 3 at most where poses are interpolated; with 6 these were 3 and 6."""

LEAST_POSES = 8
"""With fewer poses, nothing is said of their noise."""

Look = TypeVar("Look")


@dataclass(frozen=True)
class Spacing:
    """How far a keyframe is from the one before: it is enough that one of the measures that are given is reached.

    Metres, degrees and seconds are reached by the frame that is nearest to them if the next step is as the last: half
    of the step from the frame before may be missing, and a tenth of the measure at most.  So frames two metres apart,
    whose poses are never quite exact, give one keyframe every four metres if four are requested.

    metres, degrees, seconds: of their positions, headings and times.
    change: 1 less the inner product of their descriptors: 0 for equal frames, about 1 for frames of different places.
    """

    metres: float | None = None
    degrees: float | None = None
    seconds: float | None = None
    change: float | None = None

    def __bool__(self) -> bool:
        return any(measure is not None for measure in vars(self).values())


SLACK = 0.1
"""The most that may be missing of a measure."""


@dataclass
class Left:
    """Frames that no measure could judge: they have no pose, no time or no descriptor that is needed."""

    unjudged: int = 0


def keyframes(
    frames: Iterable[RecordedFrame], spacing: Spacing, describe: Describe | None = None, left: Left | None = None
) -> Iterator[RecordedFrame]:
    """The first frame and then each that is far enough from the keyframe before it.

    A frame is judged by the measures that are known of it and of the keyframe; a frame without any is left out.
    Metres and degrees are those within a segment: its first frame that has them is far from those before.
    The pose and the time of a keyframe are read if its bytes have them.

    Args:
        describe: is called, in the order of the frames, if ``spacing`` gives a change.
        left: counts the frames that could not be judged.
    """
    last: tuple[RecordedFrame, NDArray[np.float32] | None] | None = None
    previous: RecordedFrame | None = None
    for frame in frames:
        described = frame.described()
        descriptor = describe(described) if spacing.change is not None and describe is not None else None
        if not _judgeable(described, descriptor, spacing):
            if left is not None:
                left.unjudged += 1
            continue
        if last is None or previous is None or _is_far(described, descriptor, *last, previous, spacing):
            last = described, descriptor
            yield described
        previous = described


def moving(
    frames: Sequence[RecordedFrame],
    look: Callable[[RecordedFrame], Look | None],
    same: Callable[[Look, Look], bool],
    begin: int = 0,
    before: RecordedFrame | None = None,
) -> Iterator[RecordedFrame]:
    """The frames without those that show the same as the last frame before them that is not left out.

    A frame that shows the same stays where its pose says that the robot has moved, as in a tunnel: by more than
    ``STOP_METRES``, and by more than the noise of the recording's poses explains.

    Args:
        look: gives what a frame shows; None: it cannot be read, and the frame stays.
        same: whether two frames show the same.
        begin: the number of the first frame that is judged; those before it were judged already.
        before: the last of these that was not left out; it is looked at again.
    """
    last: tuple[RecordedFrame, Look] | None = None
    if before is not None and (shown_before := look(before)) is not None:
        last = before, shown_before
    apart = max(STOP_METRES, NOISE * pose_noise(frames))
    for frame in frames[begin:]:
        shown = look(frame)
        if (
            last is not None
            and shown is not None
            and same(shown, last[1])
            and (_metres(frame, last[0]) or 0.0) <= apart
        ):
            continue
        last = None if shown is None else (frame, shown)
        yield frame


def pose_noise(frames: Sequence[RecordedFrame]) -> float:
    """The standard deviation of each coordinate of the frames' poses, metres.

    It follows from how much the way of a second differs from that of the second before, which is little while a robot
    waits or drives: the median of such differences, whose coordinates have six times the variance.  A second, for
    poses between those of a receiver are interpolated.  0 if there are few poses.
    """
    poses = [pose for frame in frames if (pose := _pose(frame)) is not None]
    if len(poses) < LEAST_POSES or len({pose.kind() for pose in poses}) > 1:
        return 0.0
    times = [frame.nanoseconds for frame in frames if _pose(frame) is not None and frame.nanoseconds is not None]
    step = float(np.median(np.diff(times))) if len(times) > 1 else float(NANOSECONDS)
    second = int(np.clip(round(NANOSECONDS / max(step, 1.0)), 1, len(poses) // 3))
    positions = np.array([pose.position() for pose in poses])
    differences = positions[2 * second :] - 2 * positions[second:-second] + positions[: -2 * second]
    return float(np.median(np.linalg.norm(differences, axis=1)) / (np.sqrt(6) * np.sqrt(2 * np.log(2))))


def _judgeable(frame: RecordedFrame, descriptor: NDArray[np.float32] | None, spacing: Spacing) -> bool:
    pose = _pose(frame)
    heading = None if pose is None else pose.heading
    known = (pose, heading, frame.nanoseconds, descriptor)
    wanted = (spacing.metres, spacing.degrees, spacing.seconds, spacing.change)
    return any(fact is not None and measure is not None for fact, measure in zip(known, wanted, strict=True))


def _is_far(
    frame: RecordedFrame,
    descriptor: NDArray[np.float32] | None,
    before: RecordedFrame,
    last: NDArray[np.float32] | None,
    previous: RecordedFrame,
    spacing: Spacing,
) -> bool:
    """Whether one of the measures is reached; one that is known of the frame and not of the keyframe counts as such.

    Args:
        before: the keyframe before, of the descriptor ``last``.
        previous: the frame before, which may be the keyframe.
    """
    for measure, between in ((spacing.metres, _metres), (spacing.degrees, _degrees), (spacing.seconds, _seconds)):
        if measure is not None and between(frame, frame) is not None:  # it is known of the frame
            gone, step = between(frame, before), between(frame, previous)
            if gone is None or gone >= measure - min(abs(step or 0.0) / 2, SLACK * measure):
                return True
    return (
        spacing.change is not None
        and descriptor is not None
        and (last is None or 1 - float(descriptor @ last) >= spacing.change)
    )


def _pose(frame: RecordedFrame) -> Pose | None:
    """Where a frame lies among those of its segment."""
    return frame.local if frame.pose is None else frame.pose


def _metres(one: RecordedFrame, other: RecordedFrame) -> float | None:
    """Between two frames of a segment; endless if the pose of one is in metres and that of the other in degrees."""
    first, second = _pose(one), _pose(other)
    if first is None or second is None or one.segment != other.segment:
        return None
    if first.kind() != second.kind():
        return float("inf")
    return float(np.linalg.norm(first.position() - second.position()))


def _degrees(one: RecordedFrame, other: RecordedFrame) -> float | None:
    headings = [None if (pose := _pose(frame)) is None else pose.heading for frame in (one, other)]
    if headings[0] is None or headings[1] is None or one.segment != other.segment:
        return None
    return abs((headings[0] - headings[1] + 180) % 360 - 180)


def _seconds(one: RecordedFrame, other: RecordedFrame) -> float | None:
    if one.nanoseconds is None or other.nanoseconds is None:
        return None
    return (one.nanoseconds - other.nanoseconds) / NANOSECONDS
