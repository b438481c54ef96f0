"""Messages with the fields of ROS's, for what needs no ROS."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from placerec_ros.planar import quaternion


def header(stamp: float, frame_id: str) -> Any:
    seconds = int(stamp)
    return SimpleNamespace(
        stamp=SimpleNamespace(sec=seconds, nanosec=round(1e9 * (stamp - seconds))), frame_id=frame_id
    )


def odometry(
    stamp: float,
    x: float,
    y: float,
    yaw: float = 0.0,
    frame_id: str = "odom",
    covariance: Sequence[float] = (0.0,) * 36,
    speed: float = 0.0,
) -> Any:
    turned = quaternion(yaw)
    pose = SimpleNamespace(
        position=SimpleNamespace(x=x, y=y, z=0.0),
        orientation=SimpleNamespace(x=turned[0], y=turned[1], z=turned[2], w=turned[3]),
    )
    told = SimpleNamespace(pose=pose, covariance=covariance)
    twist = SimpleNamespace(twist=SimpleNamespace(linear=SimpleNamespace(x=speed, y=0.0, z=0.0)))
    return SimpleNamespace(header=header(stamp, frame_id), child_frame_id="base_link", pose=told, twist=twist)


def image(encoding: str, width: int, height: int, data: bytes, step: int = 0, big: int = 0) -> Any:
    return SimpleNamespace(
        encoding=encoding, width=width, height=height, step=step, is_bigendian=big, data=np.frombuffer(data, np.uint8)
    )


def camera_info(**fields: Any) -> Any:
    """A calibrated camera of 640 x 480, but for the fields given."""
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    plain = {
        "width": 640,
        "height": 480,
        "distortion_model": "plumb_bob",
        "d": [-0.28, 0.07, 0.0002, 0.0, 0.0],
        "k": [500.0, 0, 320.0, 0, 510.0, 240.0, 0, 0, 1.0],
        "p": [400.0, 0, 310.0, 0, 0, 405.0, 235.0, 0, 0, 0, 1.0, 0],
        "binning_x": 0,
        "binning_y": 0,
        "roi": roi,
    }
    return SimpleNamespace(**{**plain, **fields})
