"""Motion from odometry's own poses: whatever is lost on the way, it is counted once."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.belief import Evidence, Odometry, OdometryPose, PlaceGraph, Run, RunOptions, Step, from_bytes, to_bytes
from core.belief.odometry import FASTEST, motion_between
from core.places import Neighborhood
from tests.core.belief.maps import graph_of, posed, shows

FATES = ("ok", "request lost", "answer lost, sent again", "answer lost")
"""What happens to a frame.  The service takes it in unless the request is lost, and once if it is sent again."""

poses = st.builds(OdometryPose, *[st.floats(-1e4, 1e4)] * 2, st.floats(-20, 20))
motions = st.builds(Odometry, *[st.floats(-50, 50)] * 2, st.floats(-3, 3))


def carried(pose: OdometryPose, motion: Odometry, spread: np.ndarray | None = None) -> OdometryPose:
    """Where odometry is after a motion of that covariance, float64 [3, 3], by the law of propagation in matrices."""
    cos, sin = math.cos(pose.heading), math.sin(pose.heading)
    east, north = cos * motion.forward - sin * motion.left, sin * motion.forward + cos * motion.left
    covariance = None
    if spread is not None and pose.covariance is not None:
        moves = np.array([[1, 0, -north], [0, 1, east], [0, 0, 1]])
        turns = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        grown = moves @ np.reshape(pose.covariance, (3, 3)) @ moves.T + turns @ spread @ turns.T
        covariance = tuple(grown.ravel().tolist())
    return OdometryPose(pose.x + east, pose.y + north, pose.heading + motion.turn, covariance, pose.origin)


@given(poses, motions)
def test_the_motion_between_two_poses_is_what_led_from_one_to_the_other(pose: OdometryPose, motion: Odometry) -> None:
    found = carried(pose, motion).since(pose)
    assert (found.forward, found.left) == pytest.approx((motion.forward, motion.left), abs=1e-7)
    assert found.turn == pytest.approx(motion.turn, abs=1e-9)
    assert (found.variance, found.turn_variance) == (0, 0), "the filter's own noise stays"


@given(st.lists(motions, min_size=1, max_size=12), st.floats(0, 0.5), st.floats(0, 0.1))
def test_the_covariance_of_a_motion_is_what_the_odometry_has_gained(
    way: list[Odometry], deviation: float, turn_deviation: float
) -> None:
    spread = np.diag([deviation**2, deviation**2, turn_deviation**2])
    pose = OdometryPose(3.0, -2.0, 0.4, (0.0,) * 9)
    for motion in way:
        before, pose = pose, carried(pose, motion, spread)
    assert pose.covariance is not None
    rounding = 1e-9 * max(1.0, *map(abs, pose.covariance))  # of a long way's covariance, which is subtracted
    found = pose.since(before)
    assert found.variance == pytest.approx(deviation**2, abs=rounding)
    assert found.turn_variance == pytest.approx(turn_deviation**2, abs=rounding)


def test_a_covariance_that_does_not_grow_or_is_not_known_tells_nothing() -> None:
    same = (0.2, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.1)
    for before, after in ((same, same), (same, (0.0,) * 9), (None, same), (same, None)):
        found = OdometryPose(1, 0, 0, after).since(OdometryPose(0, 0, 0, before))
        assert (found.forward, found.variance, found.turn_variance) == (1, 0, 0)


def test_a_motion_across_a_new_beginning_is_not_known() -> None:
    here, there = OdometryPose(30, 5, 1, origin="a"), OdometryPose(30.5, 5, 1, origin="a")
    assert motion_between(here, there, None) == there.since(here)
    assert motion_between(None, there, None) is None
    assert motion_between(here, OdometryPose(30.5, 5, 1, origin="b"), None) is None
    assert motion_between(here, OdometryPose(30.5, 5, 1), None) is None
    assert motion_between(here, there, 0.6) is not None
    assert motion_between(here, there, 0.4) is None


def test_a_jump_is_judged_by_the_time_between_and_the_speed_limit() -> None:
    run = Run(RunOptions(), graph_of(posed([(float(i), 0.0) for i in range(20)])))
    run.advance(shows(3), Step(), pose=OdometryPose(30, 0, 0))
    restarted = OdometryPose(0, 0, 0)
    assert run.moved_to(restarted, None, None) is not None, "without time nothing can be said"
    assert run.moved_to(restarted, 0.1, None) is None, "300 metres a second"
    assert run.moved_to(restarted, 5.0, 1.5) is None
    for seconds, limit in ((15.0, 1.5), (1.0, None)):
        assert run.moved_to(restarted, seconds, limit) is not None
    standing = OdometryPose(30, 0, 0)
    assert run.moved_to(standing, 0.0, 1.5) == Odometry(0.0), "two frames of one moment"
    assert FASTEST > 90, "a fast train"


def test_a_frame_without_a_pose_ends_what_is_known() -> None:
    run = Run(RunOptions(), graph_of(posed([(float(i), 0.0) for i in range(20)])))
    assert run.moved_to(OdometryPose(0, 0, 0), None, None) is None, "the first one has nothing before it"
    run.advance(shows(3), Step(), pose=OdometryPose(0, 0, 0))
    assert run.moved_to(OdometryPose(1, 0, 0), None, None) == Odometry(1.0)
    told = OdometryPose(1.5, -2.0, 0.3, (0.1, 0.0, 0.02, 0.0, 0.2, 0.0, 0.02, 0.0, 0.3), "this morning's")
    run.advance(shows(4), Step(), pose=told)
    assert Run.restored(RunOptions(), run.graph, from_bytes(to_bytes(run.state()))).pose == told
    run.advance(shows(4), Step())  # moved on by the order of places, so its motion must not be applied again
    assert run.moved_to(OdometryPose(2, 0, 0), None, None) is None


WAY = [Odometry(0.0), *[Odometry(1.0)] * 2, Odometry(0.4, 0, 0.6), *[Odometry(1.0)] * 2, Odometry(0.2, 0, 0.3)]
"""The motion to each of seven frames; it begins askew in the odometry's frame and bends."""


def street() -> PlaceGraph:
    paths = [[(0.5 * i, north) for i in range(24)] for north in (0.0, 40.0)]
    return graph_of(posed(*paths), Neighborhood(1, 1))


def frame(number: int) -> Evidence:
    return shows(2 * number, 24 + 2 * number, gain=2.0)


def believed(run: Run) -> np.ndarray:
    return np.append((1 - run.belief.unknown) * run.belief.given, run.belief.unknown)


def truth(graph: PlaceGraph, taken: Sequence[int]) -> np.ndarray:
    """The belief of a run that sees the frames taken in, with the motion between them."""
    run, last = Run(RunOptions(), graph), -1
    for number in taken:
        motion = Odometry(0.0)
        for one in WAY[last + 1 : number + 1]:
            motion = motion.then(one)
        run.advance(frame(number), Step(motion, frames=number - last))
        last = number
    return believed(run)


def robot_poses() -> list[OdometryPose]:
    pose, found = OdometryPose(-7.0, 12.0, 2.0), []
    for motion in WAY:
        pose = carried(pose, motion)
        found.append(pose)
    return found


def test_every_pattern_of_lost_frames_and_answers_by_pose() -> None:
    graph, told = street(), robot_poses()
    beliefs: dict[tuple[int, ...], np.ndarray] = {}
    for fates in itertools.product(FATES, repeat=len(WAY) - 1):
        taken = (0, *(number for number, fate in enumerate(fates, 1) if fate != "request lost"))
        if taken in beliefs:
            continue  # what the robot hears changes nothing in what it sends
        run, last = Run(RunOptions(), graph), 0
        for number in taken:
            motion = run.moved_to(told[number], None, None)
            assert (motion is None) == (number == 0)
            run.advance(frame(number), Step(motion, frames=number - last), pose=told[number])
            last = number
            if number % 2:  # the service is restarted
                run = Run.restored(RunOptions(), graph, from_bytes(to_bytes(run.state())))
        beliefs[taken] = believed(run)
        np.testing.assert_allclose(beliefs[taken], truth(graph, taken), atol=1e-5)
    assert len(beliefs) == 2 ** (len(WAY) - 1)


@pytest.mark.parametrize("asks", [True, False])
def test_relative_motion_counts_once_if_the_robot_knows_what_was_taken_in(asks: bool) -> None:
    """A robot that asks the session for its last frame, or sends a frame again, is right; who sums since the last
    answer is not, as soon as an answer is lost for good."""
    graph, wrong = street(), 0
    for fates in itertools.product(FATES, repeat=3):
        run, last, since, taken = Run(RunOptions(), graph), 0, Odometry(0.0), [0]
        run.advance(frame(0), Step())
        for number, fate in enumerate(fates, 1):
            since = since.then(WAY[number])
            if fate != "request lost":
                run.advance(frame(number), Step(since, frames=number - last))
                taken.append(number)
                last = number
            if fate in ("ok", "answer lost, sent again") or (fate == "answer lost" and asks):
                since = Odometry(0.0)
        right = np.allclose(believed(run), truth(graph, taken), atol=1e-5)
        wrong += not right
        assert right or "answer lost" in fates[:2]
    assert wrong == 0 if asks else wrong > 10


def test_six_lost_answers_do_not_lose_the_robot() -> None:
    graph = graph_of(posed([(float(i), 0.0) for i in range(40)]))
    by_pose, summed = Run(RunOptions(), graph), Run(RunOptions(), graph)
    verdicts: dict[str, list[str]] = {"by pose": [], "summed": []}
    answered = 4
    for number in range(5, 20):
        seen, pose = shows(number, gain=1.5), OdometryPose(float(number), 0, 0)
        by_pose.advance(seen, Step(by_pose.moved_to(pose, None, None)), pose=pose)
        summed.advance(seen, Step(Odometry(float(number - answered))))
        if number not in range(10, 16):  # the answers to these are lost
            answered = number
        for name, run in (("by pose", by_pose), ("summed", summed)):
            verdicts[name].append(run.estimate(1, np.ones(40, np.bool_)).verdict)
    assert verdicts["by pose"][3:] == ["recognized"] * 12
    assert verdicts["summed"].count("unknown") >= 3 + 4, "the motion of a frame counts up to seven times"


def test_a_long_gap_with_odometry_is_no_jump() -> None:
    graph = graph_of(posed([(0.5 * i, 0.0) for i in range(80)]))
    run = Run(RunOptions(), graph)
    for number in range(5):
        pose = OdometryPose(0.5 * number, 0, 0)
        run.advance(shows(number), Step(run.moved_to(pose, None, None)), pose=pose)
    pose = OdometryPose(22.0, 0, 0)
    run.advance(shows(44, gain=0.5), Step(run.moved_to(pose, None, None), frames=40), pose=pose)  # 39 frames were lost
    assert abs(run.look(1, np.ones(80, np.bool_)).candidates[0].row - 44) <= 3
