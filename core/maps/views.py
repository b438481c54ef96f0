"""Which frames of a traverse show one view: those of a robot that stands, or of a camera that is faster than it.

The position of a frame in its sequence counts views, not frames, so that neighbours in time are the same whatever the
rate of a camera, and a stop is one place however long it takes.  A frame is at the position of the frame before it if
it shows nearly the same as that one, and still about the same as the first frame there.  A view may be hidden for a
moment, by somebody who passes: a frame that shows nearly the same as the first frame of one of the last few positions
is there again.

Poses decide before looks do: a frame whose pose is far from that of the first frame of a view does not show this view,
however alike the two are.  So equal doors of a long corridor are several views.

Cells of the second stage at the same spots of two frames give their similarity: freed of what all cells of
their frame have in common, the mean of their cosines.  Noise, compression and exposure change it hardly, a step of the
robot does at once.  Somebody who passes changes some of the cells and leaves the others as they were, so that two
frames show nearly the same, too, if many of their cells do.  Encoders without a second stage have descriptors only,
which noise changes more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.places import SAME_VIEW, Pose

SAME, ABOUT = 0.9, 0.8
"""Likenesses of cells from which two frames show nearly the same, and about the same.  Noise of 4 grey levels, JPEG and
5 % of exposure leave 0.98 and more by day and 0.93 by night (train/day_night); consecutive frames of corridor have 0.88
at most, those of lip6 0.76.  At 25 frames for each of theirs, a map has about one view for each reference of corridor
and three for each of lip6 (``python -m benchmarks.day.standing``)."""

UNCHANGED, STAYING = 0.96, 0.4
"""Cosine from which a cell has not changed, and the share of such cells from which two frames show nearly the same
behind what has.  Somebody who hides a fifth of the picture leaves 0.4 or more in nine cases of ten; consecutive frames
of corridor, lip6, kitti_short and train/tower have fewer.  Of train/camvid it adds the frames of a car that waits while
others drive past."""

SAME_DESCRIPTOR, ABOUT_DESCRIPTOR = 0.74, 0.6
"""The same for the cosine of descriptors.  The encoders without a second stage have 0.72 and more after such noise;
consecutive frames of corridor have 0.73 at most."""


MOST_HIDDEN = 8
"""A view may be hidden for this number of positions at most, and for no more than a map's ``same_place_frames``."""


@dataclass(frozen=True)
class ViewedFrame:
    """One frame's content and where it was taken: descriptor, float32 [D], local descriptors, int8 [C, L], and pose."""

    descriptor: NDArray[np.float32]
    local: NDArray[np.int8]
    pose: Pose | None = None


def reach_of(radius: float) -> float:
    """The largest distance in metres from a view's first look, in a map with a ``same_place_radius``."""
    return SAME_VIEW * radius


def are_apart(one: Pose | None, other: Pose | None, reach: float) -> bool:
    """Whether two poses say that two frames do not show one view; poses of different kinds, or none, do not."""
    if one is None or other is None or one.kind() != other.kind():
        return False
    return float(np.linalg.norm(one.position() - other.position())) > reach


def shows_same(one: ViewedFrame, other: ViewedFrame, about: bool = False) -> bool:
    """Whether two frames of one map show nearly the same, or ``about`` the same."""
    if one.local.size and other.local.size:
        alike = cosines(one.local, other.local)
        if not len(alike):
            return False
        return bool(alike.mean() >= (ABOUT if about else SAME) or (alike >= UNCHANGED).mean() >= STAYING)
    return cosine(one.descriptor, other.descriptor) >= (ABOUT_DESCRIPTOR if about else SAME_DESCRIPTOR)


def likeness(one: NDArray[np.int8], other: NDArray[np.int8]) -> float:
    """The mean of :func:`cosines`; 0 without any."""
    alike = cosines(one, other)
    return float(alike.mean()) if len(alike) else 0.0


def cosines(one: NDArray[np.int8], other: NDArray[np.int8]) -> NDArray[np.float32]:
    """The cosines of the cells that two frames have at the same spots, int8 [C, L] each, freed of their means.

    Returns:
        float32 [n]; cells that are hidden in one of the frames, which are zero, are left out.
    """
    seen = one.any(axis=1) & other.any(axis=1)
    if not seen.any():
        return np.empty(0, np.float32)
    a, b = (_centred(cells[seen].astype(np.float32)) for cells in (one, other))
    products = np.einsum("cl,cl->c", a, b)
    lengths = np.sqrt(np.einsum("cl,cl->c", a, a) * np.einsum("cl,cl->c", b, b))
    found: NDArray[np.float32] = products / np.maximum(lengths, 1e-9)
    return found


def _centred(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    return cells - cells.mean(axis=0)


def cosine(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """The cosine of two vectors, float32 [D], neither of them zero."""
    return float(one @ other / np.sqrt((one @ one) * (other @ other)))


class LatestViews:
    """The end of a sequence: its last frame, and the first frame of each of its last positions.

    Args:
        last: the position and the look of the last frame; None: the sequence has no frames.
        first: the look of the first frame at each of the last positions.
        positions: the number of positions that may lie between two frames of one view.
        reach: the distance in metres that may lie between the poses of a frame and of the first frame of its view.
    """

    def __init__(
        self,
        last: tuple[int, ViewedFrame] | None,
        first: Mapping[int, ViewedFrame],
        positions: int,
        reach: float = math.inf,
    ) -> None:
        self._last, self._first, self._positions, self._reach = last, dict(first), positions, reach

    def position_of(self, look: ViewedFrame) -> int | None:
        """The position of a next frame if it shows a view that is there already, else None."""
        if self._last is None:
            return None
        before, shown = self._last
        near = {at: first for at, first in self._first.items() if not are_apart(look.pose, first.pose, self._reach)}
        if before in near and shows_same(look, shown) and shows_same(look, near[before], about=True):
            return before
        for position in sorted(near, reverse=True):
            if shows_same(look, near[position]):
                return position
        return None

    def note(self, position: int, look: ViewedFrame) -> None:
        """Add the next frame, which is at a position."""
        self._last = position, look
        self._first.setdefault(position, look)
        latest = max(self._first) - self._positions
        self._first = {at: first for at, first in self._first.items() if at >= latest or at == position}


def latest_views(
    last: tuple[int, int] | None,
    first: Mapping[int, int],
    positions: int,
    reach: float,
    looks: Callable[[list[int]], list[ViewedFrame]],
) -> LatestViews:
    """The end of a sequence, whose frames are read by row.

    Args:
        last: position and row of the last frame; None: the sequence has no frames.
        first: the row of the first frame at each of the last positions.
        positions, reach: as of :class:`LatestViews`.
        looks: reads the looks of the frames in some rows.
    """
    if last is None:
        return LatestViews(None, {}, positions, reach)
    shown = looks([last[1], *first.values()])
    return LatestViews((last[0], shown[0]), dict(zip(first, shown[1:], strict=True)), positions, reach)


def leaves_view(
    pose: Pose | None, look: ViewedFrame | None, first: ViewedFrame, beside: Sequence[ViewedFrame], reach: float
) -> bool:
    """Whether a frame that was changed does not belong to its position in its sequence any more.

    It keeps its position, even if it shows something else now, so that a stop whose frames are enrolled again one after
    another in other light stays one view.  It leaves if its pose is apart from that of the first frame there, or if a
    frame before it has got another picture since, too, and shows something else.

    Args:
        pose: its pose now.
        look: its new look; None: its picture stays.
        first: the first frame there, which is before this one.
        beside: the last frame before it there that has got another picture since this one had its last, and the frames
            next before and after it there; empty if there is no such frame.
        reach: as of :class:`LatestViews`.
    """
    if are_apart(pose, first.pose, reach):
        return True
    return look is not None and bool(beside) and not any(shows_same(look, other, about=True) for other in beside)
