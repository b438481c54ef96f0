"""A run as a picture: the robot's way as it was, by odometry alone, and by the node's transform; an SVG."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from examples.simulator.run import Run
from examples.simulator.world import Hall
from placerec_ros.planar import Planar, map_to_odom

SCALE, MARGIN, LEGEND = 18.0, 24.0, 84.0
"""Pixels: of a metre, around the hall, and below it."""
TRUE, ODOMETRY, ESTIMATE, INK = "#1b7837", "#b35806", "#2166ac", "#444"
BROKEN = 2.0
"""Metres between two estimates that are not joined by a line: the robot was carried, or found."""


def svg(run: Run, hall: Hall) -> str:
    """The picture, with the walls of the hall."""
    frames = run.frames
    begin = map_to_odom(frames[0].true, frames[0].odom)  # as if it were known where odometry begins
    ways: dict[str, tuple[str, list[Planar | None]]] = {
        "where the robot was": (TRUE, [one.true for one in frames]),
        "odometry alone": (ODOMETRY, [begin.then(one.odom) for one in frames]),
        "map → odom of the node, then odometry": (ESTIMATE, [one.estimate for one in frames]),
    }
    everything = [[(pose.x, pose.y) for pose in poses if pose is not None] for _, poses in ways.values()]
    points = np.concatenate([hall.walls.reshape(-1, 2), *map(np.array, filter(None, everything))])
    low, high = points.min(axis=0), points.max(axis=0)
    width, height = (high - low) * SCALE + 2 * MARGIN

    def at(x: float, y: float) -> tuple[float, float]:
        return (x - low[0]) * SCALE + MARGIN, (high[1] - y) * SCALE + MARGIN

    parts = [_wall(*at(*start), *at(*end)) for start, end in hall.walls]
    for number, (name, (colour, poses)) in enumerate(ways.items()):
        parts += [_line([at(x, y) for x, y in piece], colour) for piece in pieces(poses)]
        row = height + 18 + 20 * number
        parts += [_line([(MARGIN, row - 4), (MARGIN + 30, row - 4)], colour), _text(MARGIN + 38, row, name)]
    marks = [("start", frames[0].true, INK), ("goal", run.end, INK)]
    for before, frame in pairwise(frames):
        if frame.carried:
            marks += [("carried off", before.true, TRUE), ("set down", frame.true, TRUE)]
            parts.append(_dashed(*at(before.true.x, before.true.y), *at(frame.true.x, frame.true.y)))
    for name, pose, colour in marks:
        x, y = at(pose.x, pose.y)
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>', _text(x + 7, y - 7, name)]
    size = f'width="{width:.0f}" height="{height + LEGEND:.0f}" viewBox="0 0 {width:.0f} {height + LEGEND:.0f}"'
    title = "<title>A robot is carried off, is found again by what it sees, and drives on to its goal</title>"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="13">{title}'
    return "\n".join([head, '<rect width="100%" height="100%" fill="#fff"/>', *parts, "</svg>", ""])


def pieces(poses: Iterable[Planar | None]) -> list[list[tuple[float, float]]]:
    """The positions of a way, in pieces that are each driven."""
    found: list[list[tuple[float, float]]] = [[]]
    for pose in poses:
        piece = found[-1]
        if pose is None or (piece and np.hypot(pose.x - piece[-1][0], pose.y - piece[-1][1]) > BROKEN):
            found.append([])
        if pose is not None:
            found[-1].append((pose.x, pose.y))
    return [piece for piece in found if len(piece) > 1]


def _line(points: Sequence[tuple[float, float]], colour: str) -> str:
    listed = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{listed}" fill="none" stroke="{colour}" stroke-width="2" stroke-opacity="0.8"/>'


def _wall(x: float, y: float, to_x: float, to_y: float) -> str:
    return f'<path d="M{x:.1f} {y:.1f}L{to_x:.1f} {to_y:.1f}" stroke="{INK}" stroke-width="3"/>'


def _dashed(x: float, y: float, to_x: float, to_y: float) -> str:
    way = f"M{x:.1f} {y:.1f}L{to_x:.1f} {to_y:.1f}"
    return f'<path d="{way}" stroke="{TRUE}" stroke-width="1.5" stroke-dasharray="2 6"/>'


def _text(x: float, y: float, text: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" fill="{INK}">{text}</text>'
