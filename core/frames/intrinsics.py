"""The intrinsics of a camera: which direction in space each pixel of its frames looks in.

Names, order and units are those of ROS's ``sensor_msgs/CameraInfo`` and of OpenCV: focal lengths and principal point
in pixels, where the centre of the upper left pixel is (0, 0), and the coefficients of one of three distortion models.
They are those of the upright frame: where EXIF data turn a picture, intrinsics are of the picture as it is shown.

A direction is a vector of the camera's optical frame: x to the right, y down, z ahead.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, FailFast, Field, model_validator

from core.errors import UnfitIntrinsics

DistortionModel = Literal["none", "plumb_bob", "rational_polynomial", "equidistant"]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Side = Annotated[int, Field(strict=True, ge=16, le=65_535)]
Vectors = NDArray[np.float64]

COEFFICIENTS: dict[DistortionModel, tuple[int, ...]] = {
    "none": (0,),
    "plumb_bob": (4, 5),
    "rational_polynomial": (8,),
    "equidistant": (4,),
}
"""How many coefficients a distortion model has: k1, k2, p1, p2 and k3; these and k4, k5, k6; k1 to k4 of a fisheye."""

SHORTEST, LONGEST = 0.05, 100.0
"""Limits of a focal length over the longer side of the frame: wider is no lens, and longer is a telescope."""
STRETCH = 4.0
"""Most by which the two focal lengths differ, as a factor."""
LEAST_SEEN = 0.75
"""The share of the frame in which a distortion model must have an inverse; calibrations may fail in the corners."""
MOST_BENT = 2.0
"""Factor by which a distortion may change the angle of a ray to the axis."""
_GRID = 16
_MOST_MISSED = 0.5
"""Pixels by which a direction, projected again, may miss the pixel that it was computed for."""
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)


class Intrinsics(BaseModel):
    """Focal lengths, principal point and distortion of a camera, for upright frames of width x height pixels."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: Side = Field(description="Pixels of a row of the upright frame for which the other values hold.")
    height: Side
    fx: Number = Field(gt=0, description="Focal length in pixels, as is fy.")
    fy: Number = Field(gt=0)
    cx: Number = Field(description="Principal point in pixels, as is cy; the first pixel's centre is at 0.")
    cy: Number
    distortion_model: DistortionModel = Field(
        default="none", description="As in ROS's CameraInfo; equidistant: fisheye."
    )
    distortion: Annotated[tuple[Number, ...], Field(max_length=8), FailFast()] = Field(
        default=(), description="k1, k2, p1, p2, k3 of plumb_bob, and k4, k5, k6; k1 to k4 of equidistant."
    )

    @model_validator(mode="after")
    def _possible(self) -> Self:
        longer = max(self.width, self.height)
        for name, focal in (("fx", self.fx), ("fy", self.fy)):
            if not SHORTEST <= focal / longer <= LONGEST:
                raise ValueError(
                    f"{name} is {focal:g} pixels; of {self.width} x {self.height} it can be "
                    f"{SHORTEST * longer:g} to {LONGEST * longer:g}"
                )
        if max(self.fx / self.fy, self.fy / self.fx) > STRETCH:
            raise ValueError(f"fx and fy differ by more than a factor of {STRETCH:g}")
        if not (-0.5 <= self.cx <= self.width - 0.5 and -0.5 <= self.cy <= self.height - 0.5):
            raise ValueError(
                f"the principal point ({self.cx:g}, {self.cy:g}) is outside of {self.width} x {self.height}"
            )
        counts = COEFFICIENTS[self.distortion_model]
        if len(self.distortion) not in counts:
            wanted = " or ".join(map(str, counts))
            raise ValueError(f"{self.distortion_model} has {wanted} coefficients, not {len(self.distortion)}")
        if self.distortion_model != "none" and (seen := self._seen()) < LEAST_SEEN:
            raise ValueError(f"the distortion cannot be undone in {1 - seen:.0%} of the frame: it is of no such lens")
        return self

    def matrix(self) -> Vectors:
        """The camera matrix K, float64 [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    @property
    def pixel(self) -> float:
        """The angle in radians that a pixel in the middle covers: the mean of both directions."""
        return float(1 / np.sqrt(self.fx * self.fy))

    @property
    def across(self) -> float:
        """The angle in radians between the left and the right edge of the frame; NaN if a distortion has no inverse."""
        middle = self.cy + 0.5
        left, right = self.bearings(np.array([[0.0, middle], [self.width, middle]]))
        return float(np.arccos(np.clip(left @ right, -1, 1)))

    def of_size(self, width: int, height: int) -> Intrinsics:
        """The intrinsics of the same camera's frames after they were scaled by one factor.

        Raises:
            UnfitIntrinsics: a frame of this size is not one of ``width`` x ``height``, scaled by one factor to within
                the rounding of its sides to whole pixels.
        """
        if (width, height) == (self.width, self.height):
            return self
        across, down = width / self.width, height / self.height
        # Some factor takes both sides to within less than a pixel of the frame's.
        least = max((width - 1) / self.width, (height - 1) / self.height)
        most = min((width + 1) / self.width, (height + 1) / self.height)
        if least >= most or min(width, height) < 1:
            raise UnfitIntrinsics(
                f"The camera's intrinsics are of frames of {self.width} x {self.height} pixels, and the frame has "
                f"{width} x {height}, which is not that scaled by one factor."
            )
        return self.model_copy(
            update={
                "width": width,
                "height": height,
                "fx": self.fx * across,
                "fy": self.fy * down,
                "cx": (self.cx + 0.5) * across - 0.5,
                "cy": (self.cy + 0.5) * down - 0.5,
            }
        )

    def bearings(self, points: Vectors) -> Vectors:
        """The directions that points of the frame look in, with the distortion undone.

        Args:
            points: float64 [n, 2], x and y in pixels from the frame's upper left *corner*, as ``Keypoints.pixels``
                gives them: the centre of the first pixel is at (0.5, 0.5).

        Returns:
            Unit vectors, float64 [n, 3]; NaN where the distortion model has no inverse.
        """
        pixels = np.asarray(points, np.float64) - 0.5
        if not len(pixels):
            return np.zeros((0, 3))
        with np.errstate(all="ignore"):
            ideal = self._undistorted(pixels)
            missed = np.abs(self._distorted(ideal) - pixels).max(axis=1)
            rays = np.column_stack([ideal, np.ones(len(ideal))])
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rays[~(missed < _MOST_MISSED)] = np.nan
        return rays

    def project(self, rays: Vectors) -> Vectors:
        """Where directions are seen: the inverse of :meth:`bearings`.

        Args:
            rays: float64 [n, 3], of any length, ahead of the camera (z > 0).

        Returns:
            float64 [n, 2], pixels from the frame's upper left corner.
        """
        return self._distorted(rays[:, :2] / rays[:, 2:]) + 0.5

    def _undistorted(self, pixels: Vectors) -> Vectors:
        """x / z and y / z of the directions of pixels, float64 [n, 2]."""
        coefficients = np.array(self.distortion)
        if self.distortion_model == "none":
            return (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        if self.distortion_model == "equidistant":
            ideal = cv2.fisheye.undistortPoints(pixels[:, np.newaxis], self.matrix(), coefficients, criteria=_CRITERIA)
        else:
            ideal = cv2.undistortPointsIter(
                pixels[:, np.newaxis], self.matrix(), coefficients, np.eye(3), np.eye(3), _CRITERIA
            )
        return np.asarray(ideal, np.float64)[:, 0]

    def _distorted(self, ideal: Vectors) -> Vectors:
        """The inverse of :meth:`_undistorted`."""
        coefficients = np.array(self.distortion)
        if self.distortion_model == "equidistant":
            pixels = cv2.fisheye.distortPoints(ideal[:, np.newaxis], self.matrix(), coefficients)
            return np.asarray(pixels, np.float64)[:, 0]
        rays = np.column_stack([ideal, np.ones(len(ideal))])
        pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), self.matrix(), coefficients)
        return np.asarray(pixels, np.float64)[:, 0]

    def _seen(self) -> float:
        """The share of the frame in which the distortion has an inverse, and bends no ray too much."""
        steps = (np.arange(_GRID) + 0.5) / _GRID
        x, y = np.meshgrid(steps * self.width, steps * self.height)
        points = np.column_stack([x.ravel(), y.ravel()])
        straight = np.linalg.norm((points - 0.5 - [self.cx, self.cy]) / [self.fx, self.fy], axis=1)
        rays = self.bearings(points)
        angles = np.arccos(np.clip(rays[:, 2], -1, 1))
        with np.errstate(invalid="ignore"):
            return float(np.mean((angles > np.arctan(straight) / MOST_BENT) & (angles < straight * MOST_BENT)))
