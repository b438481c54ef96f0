"""New ground of made-up runs: past a map's gap with odometry that drifts, and what keeps a stretch from being one."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest

from core.belief import OdometryPose, PlaceGraph, place_graph
from core.learning import GroundFrame, NewGround, RunFrame, lesson_of, new_ground_of
from core.places import METRIC, Pose, Whereabouts
from tests.core.learning.runs import (
    SAME_PLACE,
    SPACING,
    Frame,
    covered,
    heading_at,
    missed,
    point_at,
    recognized,
    walked,
    way,
)

COUNT = 80
GAP = range(25, 50)


def gapped(gap: Collection[int] = GAP) -> tuple[PlaceGraph, Frame]:
    """The way's map without some places, and frames that are recognized where the map has their place."""
    there = [number for number in range(COUNT) if number not in gap]
    points = np.array([point_at(SPACING * number) for number in there])
    position = np.column_stack([points.real, points.imag, np.zeros(len(there))])
    headings = np.degrees([heading_at(SPACING * number) for number in there]).astype(np.float32) % 360
    kind, sequence = np.full(len(there), METRIC, np.int8), np.zeros(len(there), np.int32)
    where = Whereabouts(kind, position, sequence, np.arange(len(there)), headings)
    rows = {number: row for row, number in enumerate(there)}

    def frame(number: int, pose: OdometryPose) -> RunFrame:
        return recognized(rows[number], pose) if number in rows else missed(pose)

    return place_graph(where, np.arange(len(there)), len(there), SAME_PLACE), frame


def found(graph: PlaceGraph, run: list[RunFrame]) -> NewGround:
    return new_ground_of(run, graph, lesson_of(run, graph))


def errors(graph: PlaceGraph, frames: Collection[GroundFrame], origin: int) -> list[float]:
    """Metres by which keyframes are off the truth; their numbers are those of the way."""
    x, y, _ = graph.coordinates[np.flatnonzero(graph.rows == origin)[0]]
    return [abs(complex(x, y) + one.point - point_at(SPACING * one.frame)) for one in frames]


@pytest.mark.parametrize("seed", range(6))
def test_a_gap_is_proposed_where_it_is(seed: int) -> None:
    graph, frame = gapped()
    scale = 1 + 0.05 * np.random.default_rng(seed).normal()
    run = walked(range(COUNT), frame, turns=0.014, scale=scale, seed=seed)
    (stretch,) = found(graph, run).stretches
    assert {one.frame for one in stretch.frames} == set(GAP)
    assert stretch.origin in range(GAP[0] - 3, GAP[0]) and stretch.end in range(GAP[0], GAP[0] + 4), "about its ends"
    assert stretch.length == pytest.approx(scale * SPACING * (stretch.end + len(GAP) - stretch.origin), rel=0.1)
    off = errors(graph, stretch.frames, stretch.origin)
    assert np.median(off) < 1.5 and max(off) < 2.5
    # The truth lies where the standard deviations say.
    assert np.mean([error / one.spread for error, one in zip(off, stretch.frames, strict=True)]) < 1.5
    turned = [abs(one.heading - heading_at(SPACING * one.frame)) for one in stretch.frames]
    assert max(turned) < math.radians(6)
    assert max(a / one.heading_spread for a, one in zip(turned, stretch.frames, strict=True)) < 3


def test_doubt_is_greatest_in_the_middle() -> None:
    graph, frame = gapped()
    (stretch,) = found(graph, walked(range(COUNT), frame, turns=0.014)).stretches
    spreads = [one.spread for one in stretch.frames]
    middle = len(spreads) // 2
    assert spreads[middle] > 1.1 * max(spreads[0], spreads[-1])


def test_without_drift_and_noise_the_poses_are_exact() -> None:
    graph, frame = gapped()
    (stretch,) = found(graph, walked(range(COUNT), frame, drift=0.0)).stretches
    assert max(errors(graph, stretch.frames, stretch.origin)) < 1e-6
    assert stretch.misclosure < 1e-6 and stretch.misturned < 1e-6


def test_a_misclosure_that_drift_does_not_explain_is_refused() -> None:
    graph, frame = gapped()
    run = walked(range(COUNT), frame, drift=0.02)
    moved = [
        one if number < 40 or one.pose is None else replace(one, pose=replace(one.pose, x=one.pose.x + 25))
        for number, one in enumerate(run)
    ]  # a robot that was carried in the gap
    outcome = found(graph, moved)
    assert not outcome.stretches and outcome.refused == {"misclosure": 1}


def test_a_run_that_never_comes_back_proposes_nothing() -> None:
    graph, frame = gapped(range(40, COUNT))
    outcome = found(graph, walked(range(COUNT), frame))
    assert not outcome.stretches


def test_a_run_in_the_dark_over_the_map_is_no_new_ground() -> None:
    graph, frame = gapped(())
    dark = walked(range(COUNT), lambda number, pose: missed(pose) if number in GAP else frame(number, pose))
    assert not found(graph, dark).stretches


def test_a_gap_as_narrow_as_a_place_is_no_new_ground() -> None:
    graph, frame = gapped(range(30, 34))
    outcome = found(graph, walked(range(COUNT), frame))
    assert not outcome.stretches


def test_odometry_that_begins_anew_joins_nothing() -> None:
    graph, frame = gapped()
    run = walked(range(COUNT), frame)
    restarted = [
        one if number < 40 or one.pose is None else replace(one, pose=replace(one.pose, origin="again"))
        for number, one in enumerate(run)
    ]
    outcome = found(graph, restarted)
    assert not outcome.stretches and outcome.refused == {"odometry": 1}


def test_covered_frames_and_a_robot_that_stands_give_no_place() -> None:
    graph, frame = gapped()
    rows = [*range(35), *([35] * 10), *range(35, COUNT)]
    run = walked(rows, lambda number, pose: covered(pose) if number in (28, 29) else frame(number, pose))
    (stretch,) = found(graph, run).stretches
    shown = [rows[one.frame] for one in stretch.frames]
    assert sorted(shown) == [number for number in GAP if number not in (28, 29)], "each once, the covered ones not"


def test_a_gap_in_which_most_frames_are_recognized_elsewhere_is_refused() -> None:
    graph, frame = gapped()

    def elsewhere(number: int, pose: OdometryPose) -> RunFrame:
        return recognized(number // 4, pose) if number in GAP else frame(number, pose)

    run = walked(range(COUNT), elsewhere)
    assert not found(graph, run).stretches


def test_another_building_proposes_nothing() -> None:
    graph, _ = gapped()
    assert found(graph, walked(range(COUNT), lambda _, pose: missed(pose))) == NewGround()


def test_a_map_without_poses_has_no_new_ground() -> None:
    graph = way(COUNT, posed=False)
    run = walked(range(COUNT), lambda number, pose: missed(pose) if number in GAP else recognized(number, pose))
    assert not found(graph, run).stretches


def test_a_pose_is_moved_in_metres_and_on_the_earth() -> None:
    one = GroundFrame(0, 30 + 40j, 1.0, math.radians(90), 1.0, 0.1)
    metric = one.pose(Pose(x=1, y=2, z=3))
    assert (metric.x, metric.y, metric.z, metric.heading) == pytest.approx((31, 42, 4, 90))
    assert one.pose(Pose(x=1, y=2)).z is None
    for longitude in (2.3, 179.9999):
        there = Pose(latitude=48.8, longitude=longitude)
        moved = one.pose(there)
        assert np.linalg.norm(moved.position() - there.position()) == pytest.approx(50, abs=0.01)
        assert moved.heading == pytest.approx(0, abs=1e-9), "up the map is north"
