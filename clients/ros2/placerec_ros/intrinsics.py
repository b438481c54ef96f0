"""The intrinsics of a ``sensor_msgs/CameraInfo`` as those of a camera of a map."""

from __future__ import annotations

import hashlib
import json
from typing import Any

COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
"""The distortion models of the service, and how many coefficients each has."""


class UnfitCamera(Exception):
    """The message says nothing that the service could use."""


def intrinsics_of(message: Any, rectified: bool = False) -> dict[str, Any]:
    """The intrinsics of the frames that the camera publishes, as the service takes them.

    Args:
        message: ``sensor_msgs/CameraInfo``; its binning and region of interest are applied.
        rectified: the frames are rectified: by the projection matrix P, without distortion.

    Raises:
        UnfitCamera: the camera is not calibrated, or its distortion model is not one of the service's.
    """
    if not message.width or not message.height:
        raise UnfitCamera("CameraInfo has no width and height: the camera is not calibrated")
    matrix = message.p if rectified else message.k
    fx, fy, cx, cy = (
        (matrix[0], matrix[5], matrix[2], matrix[6]) if rectified else (matrix[0], matrix[4], matrix[2], matrix[5])
    )
    if not fx > 0 or not fy > 0:
        raise UnfitCamera(f"CameraInfo has a focal length of {fx:g} by {fy:g}: the camera is not calibrated")
    left, top, width, height = _region(message)
    across, down = max(message.binning_x, 1), max(message.binning_y, 1)
    model, coefficients = ("none", []) if rectified else _distortion(message)
    return {
        "width": width // across,
        "height": height // down,
        "fx": float(fx) / across,
        "fy": float(fy) / down,
        # The centre of the first pixel is at (0, 0), before and after.
        "cx": (float(cx) - left + 0.5) / across - 0.5,
        "cy": (float(cy) - top + 0.5) / down - 0.5,
        "distortion_model": model,
        "distortion": coefficients,
    }


def _region(message: Any) -> tuple[int, int, int, int]:
    """Left, top, width and height of the part of the sensor that is published."""
    roi = message.roi
    if roi.width and roi.height:
        return roi.x_offset, roi.y_offset, roi.width, roi.height
    return 0, 0, message.width, message.height


def _distortion(message: Any) -> tuple[str, list[float]]:
    model, coefficients = message.distortion_model, [float(one) for one in message.d]
    if not any(coefficients):
        return "none", []  # all models are the pinhole then
    if model not in COUNTS:
        known = ", ".join(COUNTS)
        raise UnfitCamera(f"the distortion model {model!r} of CameraInfo is unknown to the service, which has {known}")
    most = max(COUNTS[model])
    if any(coefficients[most:]):
        raise UnfitCamera(f"{model} has {len(coefficients)} coefficients in CameraInfo; the service takes {most}")
    used = coefficients[:most]
    if len(used) not in COUNTS[model]:
        raise UnfitCamera(f"{model} has {len(used)} coefficients in CameraInfo; the service needs {min(COUNTS[model])}")
    return model, used


def camera_name(intrinsics: dict[str, Any], label: str = "") -> str:
    """A name that cameras with the same intrinsics share, and no others.

    Args:
        label: the camera's name among those of a rig, which does not share its name with the others.
    """
    text = json.dumps(intrinsics, sort_keys=True)
    return ("ros-" + hashlib.sha256(text.encode()).hexdigest()[:8] + (f"-{label}" if label else ""))[:64]
