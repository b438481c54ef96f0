"""Keyframes by distance, angle, time and change."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.places import Pose
from core.recordings import RecordedFrame
from core.recordings.frame import NANOSECONDS
from core.recordings.keyframes import SLACK, Left, Spacing, keyframes, moving, pose_noise


def frame(
    number: int, x: float | None = None, heading: float | None = None, seconds: float | None = None
) -> RecordedFrame:
    pose = None if x is None else Pose(x=x, y=0, heading=heading)
    taken = None if seconds is None else round(seconds * NANOSECONDS)
    return RecordedFrame(str(number), str(number), bytes, pose, nanoseconds=taken)


def chosen(frames: Sequence[RecordedFrame], **measures: float) -> list[int]:
    return [int(one.id) for one in keyframes(frames, Spacing(**measures))]


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=30), st.floats(0.1, 50))
def test_every_keyframe_is_far_from_the_one_before_and_no_frame_between_is(places: list[float], metres: float) -> None:
    kept = chosen([frame(index, x) for index, x in enumerate(places)], metres=metres)
    assert kept[0] == 0
    for before, after in zip(kept, [*kept[1:], len(places)], strict=True):
        assert all(abs(places[index] - places[before]) < metres for index in range(before + 1, after))
        assert after == len(places) or abs(places[after] - places[before]) >= (1 - SLACK) * metres - 1e-9


@pytest.mark.parametrize("noise", [0.0, 1e-9, 0.03])
def test_frames_two_metres_apart_give_keyframes_four_metres_apart(noise: float) -> None:
    generator = np.random.default_rng(0)
    frames = [frame(index, 2 * index + noise * generator.uniform(-1, 1), seconds=index / 3) for index in range(41)]
    assert chosen(frames, metres=4) == list(range(0, 41, 2))
    assert chosen(frames, metres=3) == list(range(0, 41, 2)), "no frame is three metres away, or nearly so"
    assert chosen(frames, seconds=1) == list(range(0, 41, 3))


@pytest.mark.parametrize("side", [6.0, 6.7])
def test_the_nearest_frame_to_a_measure_is_taken(side: float) -> None:
    """Dense frames: what was asked for is kept to within half a step, however many keyframes there are."""
    frames = [frame(index, 0.3 * index, heading=(0.7 * index) % 360) for index in range(600)]
    assert set(np.diff(chosen(frames, metres=side))) == {round(side / 0.3)}
    assert set(np.diff(chosen(frames, degrees=10.0))) == {14}
    standing = [frame(index, min(0.3 * index, 3.9)) for index in range(600)]
    assert chosen(standing, metres=4) == [0, 13], "a robot that stands still is not nearer to the measure by time"


def test_a_robot_that_stands_gives_no_further_keyframe() -> None:
    jitter = np.random.default_rng(1).uniform(-0.02, 0.02, 200)
    assert chosen([frame(index, x) for index, x in enumerate(jitter)], metres=1) == [0]


def test_one_measure_that_is_reached_is_enough() -> None:
    frames = [frame(0, 0, 350, 0), frame(1, 1, 352, 1), frame(2, 1.5, 10, 2), frame(3, 4, 12, 3), frame(4, 4, 12, 13)]
    assert chosen(frames, metres=2) == [0, 3]
    assert chosen(frames, degrees=20) == [0, 2]
    assert chosen(frames, seconds=3) == [0, 3, 4]
    assert chosen(frames, metres=2, degrees=20, seconds=10) == [0, 2, 3, 4]


def test_frames_that_cannot_be_judged_are_left_out_and_counted() -> None:
    frames = [frame(0), frame(1, 0), frame(2), frame(3, 5), frame(4, 5.5)]
    left = Left()
    assert [one.id for one in keyframes(frames, Spacing(metres=2), left=left)] == ["1", "3"]
    assert left.unjudged == 2
    frames = [frame(0, seconds=0), frame(1, 0, seconds=1), frame(2, 9, seconds=1.5)]
    assert chosen(frames, metres=2, seconds=5) == [0, 1, 2]  # the first keyframe with a pose, then by it


def test_change_is_measured_from_the_last_keyframe() -> None:
    angles = {str(index): np.radians(angle) for index, angle in enumerate((0, 20, 40, 70, 90, 95))}
    asked: list[str] = []

    def describe(one: RecordedFrame) -> NDArray[np.float32] | None:
        asked.append(one.id)
        angle = angles[one.id]
        return None if one.id == "4" else np.array([np.cos(angle), np.sin(angle)], np.float32)

    left = Left()
    frames = [frame(index) for index in range(6)]
    kept = [one.id for one in keyframes(frames, Spacing(change=1 - np.cos(np.radians(35))), describe, left)]
    assert kept == ["0", "2", "5"] and left.unjudged == 1
    assert asked == ["0", "1", "2", "3", "4", "5"]
    assert not Spacing() and Spacing(change=0)


def test_poses_in_metres_and_in_degrees_are_far_apart() -> None:
    north = RecordedFrame("1", "1", bytes, Pose(latitude=1, longitude=1))
    assert [one.id for one in keyframes([frame(0, 0), north], Spacing(metres=1e6))] == ["0", "1"]


def test_measures_on_the_earth_are_in_metres() -> None:
    frames = [RecordedFrame(str(index), "", bytes, Pose(latitude=index * 1e-5, longitude=0)) for index in range(10)]
    assert chosen(frames, metres=3.0) == [0, 3, 6, 9]  # a hundred-thousandth of a degree is 1.11 m
    assert pytest.approx(1.11, abs=0.01) == float(
        np.linalg.norm((frames[1].pose or Pose(x=0, y=0)).position() - (frames[0].pose or Pose(x=0, y=0)).position())
    )


def test_frames_that_show_what_the_last_one_shows_are_left_out() -> None:
    seen: dict[str, float | None] = dict(zip("0123456789", [0, 0.1, 0.2, 5, 5.1, None, 5, 0, 0.3, 0.6], strict=True))
    frames = [frame(number) for number in range(10)]
    kept = moving(frames, lambda one: seen[one.id], lambda a, b: abs(a - b) < 0.5)
    assert [one.id for one in kept] == ["0", "3", "5", "6", "7", "9"]


def test_who_looks_again_where_it_was_broken_off_leaves_out_the_same_frames() -> None:
    seen: dict[str, float | None] = dict(zip("0123456789", [0, 0.1, 0.2, 5, 5.1, None, 5, 0, 0.3, 0.6], strict=True))
    frames = [frame(number) for number in range(10)]
    for begin in range(11):
        found = [frames[number] for number in (0, 3, 5, 6, 7, 9) if number < begin]
        before = found[-1] if found else None
        found += moving(frames, lambda one: seen[one.id], lambda a, b: abs(a - b) < 0.5, begin, before)
        assert [one.id for one in found] == ["0", "3", "5", "6", "7", "9"], begin


def test_a_robot_whose_poses_say_that_it_moves_does_not_stand() -> None:
    frames = [frame(number, 0.4 * number) for number in range(12)]
    assert [one.id for one in moving(frames, lambda one: 0, lambda a, b: True)] == ["0", "3", "6", "9"]


@pytest.mark.thorough
@pytest.mark.parametrize("every", [1, 10], ids=["each frame has a pose of its own", "poses are interpolated"])
@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0, 3.0])
def test_noise_of_poses_moves_no_robot(noise: float, every: int) -> None:
    """Thirty seconds of a stop, and of a drive through a tunnel whose walls are the same everywhere."""
    for seed in range(20):
        noises = np.random.default_rng(seed).normal(0, noise, (2, 300 // every + 1))
        x, y = (np.interp(np.arange(300), every * np.arange(len(one)), one) for one in noises)

        def frames(speed: float, x: NDArray[np.float64] = x, y: NDArray[np.float64] = y) -> list[RecordedFrame]:
            return [
                RecordedFrame(
                    str(n), "", bytes, Pose(x=0.1 * speed * n + x[n], y=y[n]), nanoseconds=n * NANOSECONDS // 10
                )
                for n in range(300)
            ]

        stop = list(moving(frames(0.0), lambda one: 0, lambda a, b: True))
        assert len(stop) <= (1 if every == 1 else 3)
        tunnel = [int(one.id) for one in moving(frames(15.0), lambda one: 0, lambda a, b: True)]
        assert 1.5 * max(np.diff(tunnel)) <= 3 + 16 * noise, "of each stretch there is a frame"


def test_poses_on_the_earth_have_noise_in_metres() -> None:
    degrees = np.random.default_rng(0).normal(0, 1 / 111_195, (400, 2))
    poses = [Pose(latitude=60 + a, longitude=20 + b / np.cos(np.radians(60))) for a, b in degrees]
    assert pose_noise([RecordedFrame("", "", bytes, pose) for pose in poses]) == pytest.approx(1.0, abs=0.1)
    assert pose_noise([RecordedFrame("", "", bytes, pose) for pose in poses[:5]]) == 0
