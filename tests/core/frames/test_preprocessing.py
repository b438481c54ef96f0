"""The network's input against plain NumPy, and what counts as contrast."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
import pytest

from core.frames.masks import Mask
from core.frames.preprocessing import InputDefinition, contrast, prepare, second_look

MEAN, SCALE = (104.0, 117.0, 123.0), (0.5, 0.25, 0.017)


def pixels(height: int = 40, width: int = 60) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


@pytest.mark.parametrize("order", ["bgr", "rgb"])
@pytest.mark.parametrize("resize", ["linear", "area"])
@pytest.mark.parametrize("size", [(20, 30), (40, 60), (64, 33)])
def test_resized_centred_and_scaled(
    order: Literal["bgr", "rgb"], resize: Literal["linear", "area"], size: tuple[int, int]
) -> None:
    shown = InputDefinition(height=size[0], width=size[1], channel_order=order, mean=MEAN, scale=SCALE, resize=resize)
    interpolation = {"linear": cv2.INTER_LINEAR, "area": cv2.INTER_AREA}[resize]
    resized = np.asarray(cv2.resize(pixels(), size[::-1], interpolation=interpolation), np.float32)
    ordered = resized if order == "bgr" else resized[:, :, ::-1]
    wanted = (ordered - np.array(MEAN, np.float32)) * np.array(SCALE, np.float32)
    np.testing.assert_array_equal(prepare(pixels(), shown), wanted)
    room = np.full((*size, 3), np.nan, np.float32)
    assert prepare(pixels(), shown, room) is room
    np.testing.assert_array_equal(room, wanted)


def test_a_view_of_a_larger_frame_is_prepared_as_its_copy() -> None:
    shown = InputDefinition(height=20, width=30, mean=MEAN)
    view = pixels()[::2, 5:35]
    np.testing.assert_array_equal(prepare(view, shown), prepare(view.copy(), shown))


@pytest.mark.parametrize("size", [(40, 60), (480, 640), (16, 4000)])
def test_contrast_is_the_largest_standard_deviation(size: tuple[int, int]) -> None:
    frame = pixels(*size)
    frame[:, :, 1] //= 4
    stride = max(1, min(size) // 64)
    assert contrast(frame) == pytest.approx(frame[::stride, ::stride].reshape(-1, 3).std(axis=0).max(), rel=1e-9)
    assert contrast(np.full((50, 50, 3), 200, np.uint8)) == 0


def test_what_a_mask_covers_has_no_contrast() -> None:
    frame = np.full((64, 64, 3), 90, np.uint8)
    frame[:, :32] = pixels(64, 32)
    left = Mask(polygons=(((0.0, 0.0), (0.55, 0.0), (0.55, 1.0), (0.0, 1.0)),))
    assert contrast(frame) > 20 and contrast(frame, left) == 0


@pytest.mark.parametrize("shape", [(16, 16, 3), (120, 160, 3)])
def test_a_second_look_is_another_picture_of_the_same_size(shape: tuple[int, int, int]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    again = second_look(pixels)
    assert again.shape == shape
    assert again.dtype == np.uint8
    assert again.mean() < pixels.mean()
