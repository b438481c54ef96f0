"""Where the camera is on the robot, by static transforms."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from placerec_ros.frames import StaticFrames, UnfitMount, mount_of, transform_of
from placerec_ros.planar import quaternion

LEVEL = (0.0, 0.0, 0.0, 1.0)
OPTICAL = (-0.5, 0.5, -0.5, 0.5)
"""From a body frame, x ahead, to an optical one, z ahead (REP 103)."""


def transform(parent: str, child: str, moved: tuple[float, ...], turned: tuple[float, ...] = LEVEL) -> Any:
    x, y, z, w = turned
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=parent),
        child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=moved[0], y=moved[1], z=moved[2]),
            rotation=SimpleNamespace(x=x, y=y, z=z, w=w),
        ),
    )


def robot() -> StaticFrames:
    """A camera on a mast, 0.4 m ahead and 1.2 m above the base, that looks to the left by 90°."""
    made = StaticFrames()
    made.add([transform("base_link", "mast", (0.4, 0.0, 0.2)), transform("base_link", "laser", (0.1, 0.0, 0.1))])
    made.add([transform("/mast", "camera_link", (0.0, 0.1, 1.0), quaternion(math.radians(90)))])
    made.add([transform("camera_link", "camera_optical_frame", (0.0, 0.0, 0.0), OPTICAL)])
    return made


@pytest.mark.parametrize("frame", ["camera_optical_frame", "camera_link"])
def test_the_camera_is_found_over_several_frames(frame: str) -> None:
    found = robot().between("base_link", frame)
    assert found is not None
    mount = mount_of(found, frame)
    assert (mount.x, mount.y, mount.z, math.degrees(mount.yaw)) == pytest.approx((0.4, 0.1, 1.2, 90))


def test_frames_beside_each_other_are_connected_by_what_is_above_them() -> None:
    made = robot()
    found = made.between("laser", "camera_link")
    assert found is not None
    assert found[:3, 3] == pytest.approx((0.3, 0.1, 1.1))
    back = made.between("camera_link", "laser")
    assert back is not None
    np.testing.assert_allclose(found @ back, np.eye(4), atol=1e-12)
    assert made.between("base_link", "arm") is None
    assert made.between("odom", "camera_link") is None


def test_frames_in_a_circle_end() -> None:
    made = StaticFrames()
    made.add([transform("a", "b", (1.0, 0.0, 0.0)), transform("b", "a", (1.0, 0.0, 0.0))])
    assert made.between("a", "c") is None


def test_a_camera_that_looks_up_has_no_heading() -> None:
    up = transform_of((0.0, 0.0, 1.0), (0.0, -math.sin(math.radians(40)), 0.0, math.cos(math.radians(40))))
    assert up is not None
    with pytest.raises(UnfitMount, match="up or down by 80°"):
        mount_of(up, "camera_link")


@pytest.mark.parametrize("broken", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0)])
def test_what_is_no_transform_is_left_out(broken: tuple[float, ...]) -> None:
    made = StaticFrames()
    made.add([transform("base_link", "camera", (0.0, 0.0, 0.0), broken)])
    assert made.between("base_link", "camera") is None
