"""Poses by TF: trees over time, with the camera's place on the robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from core.errors import InvalidTrajectory
from core.recordings import Poses, open_recording
from core.recordings.messages import Transform
from core.recordings.transforms import TransformTree
from tests.core.recordings.bags import SECOND, START, WRITERS, Said, compressed, header
from tests.service.scenes import jpeg

OPTICAL = Rotation.from_euler("ZYX", [-90, 0, -90], degrees=True).as_quat()
"""The turn from a body to its camera's optical frame, as REP 103 has it."""


def transform(parent: str, child: str, stamp: int, moved: Any, degrees: float = 0.0, turned: Any = None) -> Transform:
    turn = Rotation.from_euler("z", degrees, degrees=True).as_quat() if turned is None else turned
    return Transform(parent, child, stamp, np.array(moved, float), np.array(turn))


def tree(*transforms: Transform) -> TransformTree:
    made = TransformTree()
    made.add(transforms, 0)
    return made


def poses(made: TransformTree, fixed: str | None, moving: str, *seconds: float) -> list[tuple[float, ...]]:
    """x, y, z and heading at some times."""
    found = made.trajectory(fixed, moving, most_speed=1e3).trajectory.at([round(one * SECOND) for one in seconds], 10.0)
    return [(pose.x, pose.y, pose.z, pose.heading) for pose in found if pose is not None]  # type: ignore[misc]


def driving(*more: Transform) -> TransformTree:
    """A robot that drives along y of a map in which odometry began turned by 90°, its camera ahead and looking left."""
    return tree(
        transform("map", "odom", 1, (10, 0, 0), 90),
        *(transform("odom", "base_link", second * SECOND, (second, 0, 0)) for second in range(5)),
        transform("base_link", "camera_link", 1, (0.5, 0, 1.2), 90),
        transform("camera_link", "camera_optical_frame", 1, (0, 0, 0), turned=OPTICAL),
        *more,
    )


def test_the_pose_of_the_camera_has_its_place_on_the_robot() -> None:
    for frame in ("camera_link", "camera_optical_frame"):
        found = poses(driving(), None, frame, 0, 1.5, 4)
        assert found == [pytest.approx((10, y + 0.5, 1.2, 180)) for y in (0, 1.5, 4)]
    assert poses(driving(), "odom", "base_link", 2)[0] == pytest.approx((2, 0, 0, 0))
    assert poses(driving(), "map", "base_link", 2)[0] == pytest.approx((10, 2, 0, 90))


def test_a_frame_may_be_seen_from_any_other() -> None:
    """Of inverted edges, too: where the map is in the robot's frame."""
    assert poses(driving(), "base_link", "map", 2)[0] == pytest.approx((-2, 10, 0, 270))
    sibling = transform("map", "dock", 1, (10, 4, 0))
    assert poses(driving(sibling), "dock", "base_link", 1)[0] == pytest.approx((0, -3, 0, 90))


def test_transforms_that_come_at_other_times_are_interpolated() -> None:
    made = tree(
        *(transform("map", "odom", round(at * SECOND), (0, at, 0)) for at in (0, 2.5, 5)),
        *(transform("odom", "base", second * SECOND, (second, 0, 0), 10 * second) for second in range(1, 5)),
    )
    trajectory = made.trajectory("map", "base").trajectory
    assert (trajectory.nanoseconds / SECOND).tolist() == [1, 2, 2.5, 3, 4], "within the times of both"
    assert poses(made, "map", "base", 2, 2.5, 3.5) == [pytest.approx((t, t, 0, 10 * t)) for t in (2, 2.5, 3.5)]


def test_the_interpolation_is_that_of_matrices() -> None:
    generator = np.random.default_rng(3)
    steps = [
        (parent, child, generator.normal(size=3), Rotation.random(random_state=generator).as_quat())
        for parent, child in (("map", "odom"), ("odom", "base"), ("base", "lens"))
    ]
    made = tree(*(transform(p, c, t, m, turned=q) for p, c, m, q in steps for t in (5, 6)))
    matrix = np.eye(4)
    for _, _, moved, turned in steps:
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_quat(turned).as_matrix(), moved
        matrix = matrix @ step
    found = made.trajectory("map", "lens").trajectory
    assert found.positions[0] == pytest.approx(matrix[:3, 3])
    assert Rotation.from_quat(found.turns[0]).as_matrix() == pytest.approx(matrix[:3, :3])
    back = made.trajectory("lens", "map").trajectory
    assert back.positions[0] == pytest.approx(np.linalg.inv(matrix)[:3, 3])


CIRCLE = tree(
    *(transform(parent, child, t, (t, 0, 0)) for parent, child in (("a", "b"), ("b", "a")) for t in (1, 2)),
    *(transform("x", "y", t, (0, 0, 0)) for t in (1, 2)),
)


@pytest.mark.parametrize(
    ("made", "fixed", "moving", "said"),
    [
        (tree(), None, "base", "no transform of a frame 'map'. There are: none"),
        (driving(), "world", "base_link", "no transform of a frame 'world'. There are: base_link, camera_link"),
        (driving(), "map", "lidar", "no transform of a frame 'lidar'"),
        (driving(transform("mars", "rover", 1, (0, 0, 0))), "map", "rover", "No transforms lead from 'map' to 'rover'"),
        (driving(), "base_link", "camera_link", "never moves"),
        (
            tree(
                *(transform("map", "odom", t, (0, 0, 0)) for t in (1, 2)),
                *(transform("odom", "base", t, (t, 0, 0)) for t in (8, 9)),
            ),
            "map",
            "base",
            "no time in common",
        ),
        (CIRCLE, "x", "b", "No transforms lead"),
    ],
)
def test_what_gives_no_path_says_why(made: TransformTree, fixed: str | None, moving: str, said: str) -> None:
    with pytest.raises(InvalidTrajectory, match=said):
        made.trajectory(fixed, moving)


def said(topic: str, stamp: int, *found: Transform) -> Said:
    """A message of TF."""

    def make(store: Any) -> Any:
        types = store.types

        def one(part: Transform) -> Any:
            head = header(store, part.stamp)
            head.frame_id = part.parent
            moved = types["geometry_msgs/msg/Vector3"](*part.moved.tolist())
            turned = types["geometry_msgs/msg/Quaternion"](*part.turned.tolist())
            inner = types["geometry_msgs/msg/Transform"](translation=moved, rotation=turned)
            return types["geometry_msgs/msg/TransformStamped"](header=head, child_frame_id=part.child, transform=inner)

        return types["tf2_msgs/msg/TFMessage"](transforms=[one(part) for part in found])

    return Said(topic, "tf2_msgs/msg/TFMessage", stamp, make)


@pytest.mark.parametrize("writer", ["sqlite", "mcap-zstd", "mcap-of-ros1", "ros1"])
def test_the_frames_of_a_bag_get_the_poses_of_their_camera(writer: str, tmp_path: Path) -> None:
    messages = [said("/tf_static", START, transform("base_link", "camera", 0, (0.2, 0, 1), 180))]
    for number in range(4):
        at = START + number * SECOND
        messages.append(said("/tf", at, transform("odom", "base_link", at, (number, 0, 0))))
        messages.append(compressed(at + SECOND // 2, jpeg(number)))
    messages.append(said("/tf", START + 4 * SECOND, transform("odom", "base_link", START + 4 * SECOND, (4, 0, 0))))
    path = WRITERS[writer](tmp_path, messages)
    with open_recording(path, poses=Poses(topic="/tf")) as recording:
        found = [frame.pose for frame in recording.frames]
    assert [(p.x, p.y, p.z, p.heading) for p in found if p is not None] == [
        pytest.approx((number + 0.7, 0, 1, 180)) for number in range(4)
    ]
    with open_recording(path, poses=Poses(topic="/tf", fixed="odom", moving="base_link")) as recording:
        first = recording.frames[0].pose
        assert first is not None and (first.x, first.z, first.heading) == (0.5, 0, 0)
    with pytest.raises(InvalidTrajectory, match="no transform of a frame 'lens'"):
        open_recording(path, poses=Poses(topic="/tf", moving="lens"))
