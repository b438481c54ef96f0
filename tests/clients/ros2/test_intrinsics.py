"""CameraInfo as intrinsics of a map's camera."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from core.frames.intrinsics import Intrinsics
from placerec_ros.intrinsics import UnfitCamera, camera_name, intrinsics_of
from tests.clients.ros2.ros_messages import camera_info


def test_the_service_takes_them_as_they_are() -> None:
    found = Intrinsics(**intrinsics_of(camera_info()))
    assert (found.width, found.height, found.fx, found.fy, found.cx, found.cy) == (640, 480, 500, 510, 320, 240)
    assert found.distortion_model == "plumb_bob"
    assert found.distortion == (-0.28, 0.07, 0.0002, 0.0, 0.0)


def test_rectified_frames_have_those_of_the_projection() -> None:
    found = intrinsics_of(camera_info(), rectified=True)
    assert [found[name] for name in ("fx", "fy", "cx", "cy")] == [400.0, 405.0, 310.0, 235.0]
    assert found["distortion_model"] == "none"


def test_binning_keeps_every_direction() -> None:
    """A pixel of the binned frame looks where the middle of its four pixels looked."""
    whole = Intrinsics(**intrinsics_of(camera_info(d=[])))
    binned = Intrinsics(**intrinsics_of(camera_info(d=[], binning_x=2, binning_y=2)))
    assert (binned.width, binned.height) == (320, 240)
    corner = np.array([[100.0, 60.0]])  # from the frame's upper left corner
    np.testing.assert_allclose(binned.bearings(corner), whole.bearings(2 * corner))


def test_a_region_of_interest_keeps_every_direction() -> None:
    roi = SimpleNamespace(x_offset=40, y_offset=20, width=500, height=400, do_rectify=False)
    whole = Intrinsics(**intrinsics_of(camera_info(d=[])))
    part = Intrinsics(**intrinsics_of(camera_info(d=[], roi=roi)))
    assert (part.width, part.height) == (500, 400)
    point = np.array([[100.0, 60.0]])
    np.testing.assert_allclose(part.bearings(point), whole.bearings(point + np.array([40.0, 20.0])))


@pytest.mark.parametrize(
    ("model", "given", "expected"),
    [
        ("plumb_bob", [], ("none", [])),
        ("", [], ("none", [])),
        ("plumb_bob", [0.0] * 5, ("none", [])),
        ("plumb_bob", [0.1, 0.0, 0.0, 0.0], ("plumb_bob", [0.1, 0.0, 0.0, 0.0])),
        ("rational_polynomial", [0.1] * 8 + [0.0] * 6, ("rational_polynomial", [0.1] * 8)),
        ("equidistant", [0.1, 0.0, 0.0, 0.0], ("equidistant", [0.1, 0.0, 0.0, 0.0])),
    ],
)
def test_distortions_are_those_of_the_service(model: str, given: list[float], expected: Any) -> None:
    found = intrinsics_of(camera_info(distortion_model=model, d=given))
    assert (found["distortion_model"], found["distortion"]) == expected


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"k": [0.0] * 9}, "not calibrated"),
        ({"width": 0}, "not calibrated"),
        ({"k": [float("nan")] * 9}, "not calibrated"),
        ({"distortion_model": "thin_prism"}, "'thin_prism' of CameraInfo is unknown"),
        ({"distortion_model": "rational_polynomial", "d": [0.1] * 14}, "14 coefficients"),
        ({"distortion_model": "equidistant", "d": [0.1]}, "1 coefficients"),
    ],
)
def test_what_says_nothing_is_refused(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(UnfitCamera, match=said):
        intrinsics_of(camera_info(**fields))


def test_a_camera_is_named_by_its_intrinsics() -> None:
    one = camera_name(intrinsics_of(camera_info()))
    assert one == camera_name(intrinsics_of(camera_info()))
    assert one != camera_name(intrinsics_of(camera_info(width=1280)))
    assert len(one) == 12
