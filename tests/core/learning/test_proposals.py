"""The lessons of runs: dark stretches between recognized frames, and nothing that anything speaks against."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.belief import OdometryPose, PlaceGraph
from core.learning import Lesson, LessonOptions, RunFrame, lesson_of
from tests.core.learning.runs import covered, except_at, keypoints, missed, recognized, seen_at, walked, way

ROWS = list(range(60))
HIDDEN = [10, 11, 25, 26, 27, 28, 40]


@pytest.fixture(scope="module")
def graph() -> PlaceGraph:
    return way(80)


def proposed(lesson: Lesson) -> dict[int, int]:
    """The row that each frame is proposed at."""
    return {one.frame: one.row for one in lesson.proposals}


def test_missed_frames_are_proposed_at_their_places(graph: PlaceGraph) -> None:
    lesson = lesson_of(walked(ROWS, except_at(HIDDEN)), graph)
    assert lesson.contradiction is None
    assert sorted(proposed(lesson)) == HIDDEN
    for one in lesson.proposals:
        assert abs(one.row - one.frame) <= 1
        assert one.certainty >= 0.95
        assert one.anchors[0] < one.frame < one.anchors[1]
        assert one.geometry is None
        assert "unknown" in one.why and str(one.anchors[0]) in one.why


@pytest.mark.thorough
@settings(deadline=None, max_examples=25)
@given(st.sets(st.integers(6, 53), max_size=30), st.integers(0, 1000))
def test_no_frame_is_proposed_at_another_place(hidden: set[int], seed: int) -> None:
    frames = walked(ROWS, except_at(sorted(hidden)), turns=0.01, seed=seed)
    for frame, row in proposed(lesson_of(frames, way(80))).items():
        assert frame in hidden
        assert abs(row - frame) <= 2


def test_a_frame_that_recognition_misplaced_is_proposed_where_the_run_has_it(graph: PlaceGraph) -> None:
    def misplaced(_row: int, pose: OdometryPose) -> RunFrame:
        return recognized(70, pose)

    lesson = lesson_of(walked(ROWS, except_at([30], misplaced)), graph)
    assert abs(proposed(lesson)[30] - 30) <= 1
    assert lesson.contradicted.tolist() == [30]


def test_a_covered_view_and_one_that_stays_teach_nothing(graph: PlaceGraph) -> None:
    def constant(row: int, pose: OdometryPose) -> RunFrame:
        return replace(missed(pose), sight="constant") if row == 20 else covered(pose)

    lesson = lesson_of(walked(ROWS, except_at([20, 35], constant)), graph)
    assert proposed(lesson) == {}
    assert lesson.refused["constant"] == lesson.refused["covered"] == 1


def test_standing_does_not_prove_a_place(graph: PlaceGraph) -> None:
    """A robot stands before a view that is mistaken for another place, again and again."""
    rows = [*range(20), *[20] * 40, *range(21, 40)]

    def mistaken(_row: int, pose: OdometryPose) -> RunFrame:
        return RunFrame(seen_at(60), "recognized", 0.95, 60, pose, "constant")

    frames = walked(rows, except_at([20], mistaken))
    frames[20] = replace(frames[20], sight=None)
    lesson = lesson_of(frames, graph)
    assert {row for row in lesson.rows.tolist() if row > 45} == set()
    assert set(proposed(lesson)) <= {20}


def test_a_robot_in_another_building_teaches_nothing(graph: PlaceGraph) -> None:
    random = np.random.default_rng(1)

    def elsewhere(_row: int, pose: OdometryPose) -> RunFrame:
        row = int(random.integers(80))
        return recognized(row, pose) if random.random() < 0.3 else missed(pose)

    lesson = lesson_of(walked(ROWS, elsewhere), graph)
    assert lesson.proposals == ()
    assert lesson.contradiction is not None
    assert (lesson.rows == -1).all()


def test_a_robot_that_recognizes_nothing_teaches_nothing(graph: PlaceGraph) -> None:
    lesson = lesson_of(walked(ROWS, lambda _row, pose: missed(pose)), graph)
    assert (lesson.proposals, lesson.contradiction) == ((), "too few recognized")


def test_few_recognized_frames_teach_if_that_is_allowed(graph: PlaceGraph) -> None:
    frames = walked(ROWS[:6], except_at([2]))
    assert lesson_of(frames, graph).contradiction == "too few recognized"
    assert lesson_of(frames, graph, LessonOptions(least_anchors=3)).contradiction is None


@pytest.mark.parametrize("scale", [0.5, 1.6])
def test_wrong_odometry_teaches_nothing(graph: PlaceGraph, scale: float) -> None:
    lesson = lesson_of(walked(ROWS, except_at(HIDDEN), scale=scale), graph)
    assert lesson.proposals == ()
    assert lesson.contradiction in ("odometry", "contradicted")


def test_odometry_that_turns_at_random_teaches_nothing(graph: PlaceGraph) -> None:
    lesson = lesson_of(walked(ROWS, except_at(HIDDEN), turns=1.5), graph)
    assert lesson.proposals == ()


def test_a_run_without_odometry_teaches_nothing(graph: PlaceGraph) -> None:
    frames = [replace(one, pose=None) for one in walked(ROWS, except_at(HIDDEN))]
    assert lesson_of(frames, graph).proposals == ()


def test_nothing_is_taught_across_a_kidnapping(graph: PlaceGraph) -> None:
    """The robot is carried on by 30 places within a dark stretch, and odometry does not notice."""
    before, after = walked(range(25), except_at(range(20, 25))), walked(range(50, 75), except_at(range(50, 55)))
    last, first = before[-1].pose, after[0].pose
    assert last is not None and first is not None
    turn = last.heading - first.heading
    carried = []
    for one in after:
        assert one.pose is not None
        apart = complex(one.pose.x - first.x, one.pose.y - first.y) * np.exp(1j * turn)
        ahead = 2 * np.exp(1j * last.heading)
        pose = OdometryPose(
            float(last.x + ahead.real + apart.real), float(last.y + ahead.imag + apart.imag), one.pose.heading + turn
        )
        carried.append(replace(one, pose=pose))
    lesson = lesson_of([*before, *carried], graph)
    assert len(lesson.anchors) == 40
    assert lesson.proposals == ()


def test_nothing_is_taught_where_odometry_began_anew(graph: PlaceGraph) -> None:
    frames = walked(ROWS, except_at(range(28, 32)))
    anew = [replace(one, pose=replace(one.pose, origin="anew")) if one.pose else one for one in frames[30:]]
    lesson = lesson_of([*frames[:30], *anew], graph)
    assert lesson.contradiction is None
    assert lesson.proposals == ()


def test_a_detour_teaches_nothing(graph: PlaceGraph) -> None:
    """The robot goes up to 15 m aside, where the map has no place, and comes back."""
    frames = walked(ROWS, except_at([]))
    pose = frames[30].pose
    assert pose is not None
    aside = [
        missed(
            OdometryPose(
                pose.x - 15 * math.sin(math.pi * step / 11) * math.sin(pose.heading),
                pose.y + 15 * math.sin(math.pi * step / 11) * math.cos(pose.heading),
                pose.heading,
            )
        )
        for step in range(1, 11)
    ]
    lesson = lesson_of([*frames[:31], *aside, *frames[31:]], graph)
    assert lesson.contradiction is None
    assert set(proposed(lesson)) <= {31, 40}  # 4 m aside


def test_a_robot_that_looks_another_way_teaches_nothing(graph: PlaceGraph) -> None:
    frames = walked(ROWS, except_at([30]))
    pose = frames[30].pose
    assert pose is not None
    frames[30] = replace(frames[30], pose=replace(pose, heading=pose.heading + math.radians(80)))
    assert proposed(lesson_of(frames, graph)) == {}


def test_keypoints_of_a_frame_beside_confirm_or_deny(graph: PlaceGraph) -> None:
    """Frame 20 shows the scene that frames 19 and 21 show; frame 40 shows another than 39 and 41."""

    def frame(row: int, pose: OdometryPose) -> RunFrame:
        if row in (20, 40):
            return missed(pose, keypoints(1 if row == 20 else 9, shift=0.02))
        return recognized(row, pose, keypoints(1) if row in (19, 21, 39, 41) else None)

    lesson = lesson_of(walked(ROWS, frame), graph)
    (only,) = lesson.proposals
    assert only.frame == 20
    assert only.geometry is not None and only.geometry > 60
    assert lesson.refused["geometry"] == 1


def test_anchors_that_are_far_before_or_after_do_not_count(graph: PlaceGraph) -> None:
    lesson = lesson_of(walked(ROWS, except_at(range(10, 50))), graph)
    assert set(proposed(lesson)).isdisjoint(range(24, 36))


def test_a_map_without_poses_learns_along_its_sequence() -> None:
    graph = way(80, posed=False)
    found = proposed(lesson_of(walked(ROWS, except_at(HIDDEN)), graph))
    assert set(found) <= set(HIDDEN)
    assert len(found) >= 4
    assert all(abs(row - frame) <= 1 for frame, row in found.items())


def test_an_empty_map_learns_nothing() -> None:
    lesson = lesson_of(walked(ROWS[:3], except_at([])), way(0))
    assert lesson.contradiction == "no places"
    assert lesson_of([], way(3)).contradiction == "no places"


def test_a_dark_run_with_evidence_of_its_own_is_still_not_sure(graph: PlaceGraph) -> None:
    """The frames speak for their places, but none is recognized: nobody vouches for the run."""

    def doubtful(row: int, pose: OdometryPose) -> RunFrame:
        return RunFrame(seen_at(row, 1.5), "ambiguous", 0.4, row, pose)

    assert lesson_of(walked(ROWS, doubtful), graph).contradiction == "too few recognized"
