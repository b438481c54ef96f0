"""Made-up maps and runs: places along a way every two metres, and robots that go along it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from core.belief import NOTHING, Evidence, OdometryPose, PlaceGraph, place_graph
from core.geometry.keypoints import Keypoints
from core.judgement.verdict import Verdict
from core.learning import RunFrame
from core.places import METRIC, NO_POSE, Neighborhood, Whereabouts

SPACING = 2.0
SAME_PLACE = Neighborhood(radius=5.0, frames=3)


def heading_at(metres: float) -> float:
    """Of the way, which winds, in radians."""
    return 0.6 * math.sin(metres / 20)


def point_at(metres: float) -> complex:
    """Where the way is, x + iy."""
    along = np.arange(0, metres, 0.1)
    return complex(np.sum(0.1 * np.exp(1j * 0.6 * np.sin(along / 20))))


def way(count: int, posed: bool = True) -> PlaceGraph:
    """The graph of a map of ``count`` places along the way, in one sequence."""
    points = np.array([point_at(SPACING * number) for number in range(count)])
    kind = np.full(count, METRIC if posed else NO_POSE, np.int8)
    position = np.column_stack([points.real, points.imag, np.zeros(count)]) * posed
    where = Whereabouts(kind, position, np.zeros(count, np.int32), np.arange(count))
    return place_graph(where, np.arange(count), count, SAME_PLACE)


def seen_at(row: int, gain: float = 3.0) -> Evidence:
    """A frame that speaks for one row."""
    return Evidence(np.array([row]), np.array([gain], np.float32), 1.0)


def dark() -> Evidence:
    """A frame that speaks for no row."""
    return Evidence(np.empty(0, np.int64), np.empty(0, np.float32), 1.0)


def recognized(row: int, pose: OdometryPose, keypoints: Keypoints | None = None) -> RunFrame:
    """A frame that was recognized alone."""
    return RunFrame(seen_at(row), "recognized", 0.95, row, pose, None, keypoints)


def missed(pose: OdometryPose, keypoints: Keypoints | None = None, verdict: Verdict = "unknown") -> RunFrame:
    """A frame that nobody recognized alone."""
    return RunFrame(dark(), verdict, 0.1, 0, pose, None, keypoints)


def covered(pose: OdometryPose) -> RunFrame:
    """A frame that shows hardly anything."""
    return RunFrame(NOTHING, "unknown", 0.0, None, pose, "covered")


Frame = Callable[[int, OdometryPose], RunFrame]


def walked(
    rows: Sequence[int], frame: Frame, drift: float = 0.05, turns: float = 0.0, scale: float = 1.0, seed: int = 0
) -> list[RunFrame]:
    """A run past some rows of the way, with odometry that drifts.

    Args:
        frame: returns the frame at a row, with its pose.
        drift: standard deviation of each step, as a share of it.
        turns: of each step's heading, radians.
        scale: of all steps.
    """
    random = np.random.default_rng(seed)
    there = [(point_at(SPACING * row), heading_at(SPACING * row)) for row in rows]
    odometry, heading, found = 5 + 7j, 1.1, []  # odometry begins anywhere
    for number, (row, (point, direction)) in enumerate(zip(rows, there, strict=True)):
        if number:
            before, facing = there[number - 1]
            step = (point - before) * np.exp(-1j * facing) * scale * (1 + drift * random.normal())
            odometry += complex(step * np.exp(1j * heading))
            heading += direction - facing + turns * random.normal()
        found.append(frame(row, OdometryPose(odometry.real, odometry.imag, heading)))
    return found


def except_at(rows: Sequence[int], other: Frame | None = None) -> Frame:
    """Frames that are recognized, but those at ``rows``, which are missed or as ``other`` makes them."""
    hidden = set(rows)

    def frame(row: int, pose: OdometryPose) -> RunFrame:
        if row not in hidden:
            return recognized(row, pose)
        return missed(pose) if other is None else other(row, pose)

    return frame


def keypoints(seed: int, count: int = 120, shift: float = 0.0, extra: int = 0) -> Keypoints:
    """Keypoints of a made-up scene by its seed; ``shift``, a share of the width, moves those of a scene sideways."""
    random = np.random.default_rng(seed)
    shares = random.uniform(0.2, 0.8, (count, 2))
    descriptors = random.normal(0, 1, (count, 64))
    others = np.random.default_rng((seed, extra, 1))
    if extra:
        shares = np.concatenate([shares, others.uniform(0.05, 0.95, (extra, 2))])
        descriptors = np.concatenate([descriptors, others.normal(0, 1, (extra, 64))])
    shares = shares + np.array([shift, 0.0])
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    quantized = np.clip(np.rint(254 * descriptors / lengths), -127, 127).astype(np.int8)
    return Keypoints(640, 480, np.rint(shares * 65535).astype(np.uint16), quantized)
