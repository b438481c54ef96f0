"""Keyframes: the frames of a recording that show something new, by distance, angle, time or change of descriptor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.places import Pose
from core.recordings.frame import NANOSECONDS, Frame

Describe = Callable[[Frame], NDArray[np.float32] | None]
"""Gives the descriptor of a frame, float32 [D], of length 1; None if it has none."""


@dataclass(frozen=True)
class Spacing:
    """How far a keyframe is from the one before: it is enough that one of the measures that are given is reached.

    metres, degrees, seconds: of their positions, headings and times.
    change: 1 less the inner product of their descriptors: 0 for equal frames, about 1 for frames of different places.
    """

    metres: float | None = None
    degrees: float | None = None
    seconds: float | None = None
    change: float | None = None

    def __bool__(self) -> bool:
        return any(measure is not None for measure in vars(self).values())


@dataclass
class Left:
    """Frames that no measure could judge: they have no pose, no time or no descriptor that is needed."""

    unjudged: int = 0


def keyframes(
    frames: Iterable[Frame], spacing: Spacing, describe: Describe | None = None, left: Left | None = None
) -> Iterator[Frame]:
    """The first frame and then each that is far enough from the keyframe before it.

    A frame is judged by the measures that are known of it and of the keyframe; one of which none is known is left out.
    The pose and the time of a keyframe are read if its bytes tell them.

    Args:
        describe: is called, in the order of the frames, if ``spacing`` gives a change.
        left: counts the frames that could not be judged.
    """
    last: tuple[Frame, NDArray[np.float32] | None] | None = None
    for frame in frames:
        described = frame.described()
        descriptor = describe(described) if spacing.change is not None and describe is not None else None
        if not _judgeable(described, descriptor, spacing):
            if left is not None:
                left.unjudged += 1
            continue
        if last is None or _is_far(described, descriptor, *last, spacing):
            last = described, descriptor
            yield described


def _judgeable(frame: Frame, descriptor: NDArray[np.float32] | None, spacing: Spacing) -> bool:
    heading = None if frame.pose is None else frame.pose.heading
    known = (frame.pose, heading, frame.nanoseconds, descriptor)
    wanted = (spacing.metres, spacing.degrees, spacing.seconds, spacing.change)
    return any(fact is not None and measure is not None for fact, measure in zip(known, wanted, strict=True))


def _is_far(
    frame: Frame,
    descriptor: NDArray[np.float32] | None,
    before: Frame,
    last: NDArray[np.float32] | None,
    spacing: Spacing,
) -> bool:
    """Whether one of the measures is reached; one that is known of the frame and not of the keyframe counts as such."""
    reached = []
    if spacing.metres is not None and frame.pose is not None:
        reached.append(before.pose is None or _distance(frame.pose, before.pose) >= spacing.metres)
    if spacing.degrees is not None and frame.pose is not None and frame.pose.heading is not None:
        heading = None if before.pose is None else before.pose.heading
        reached.append(heading is None or abs((frame.pose.heading - heading + 180) % 360 - 180) >= spacing.degrees)
    if spacing.seconds is not None and frame.nanoseconds is not None:
        elapsed = None if before.nanoseconds is None else frame.nanoseconds - before.nanoseconds
        reached.append(elapsed is None or elapsed >= spacing.seconds * NANOSECONDS)
    if spacing.change is not None and descriptor is not None:
        reached.append(last is None or 1 - float(descriptor @ last) >= spacing.change)
    return any(reached)


def _distance(one: Pose, other: Pose) -> float:
    """Metres between two poses; endless if one is in metres and the other in degrees."""
    if one.kind() != other.kind():
        return float("inf")
    return float(np.linalg.norm(one.position() - other.position()))
