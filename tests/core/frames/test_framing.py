"""Framings: a frame in the view of a place, and where things are in both."""

from __future__ import annotations

import numpy as np
import pytest

from core.frames.framing import SAME_VIEW, Framing
from core.frames.masks import Mask
from tests.service.scenes import scene


def cut(pixels: np.ndarray, share: float) -> np.ndarray:
    height, width = pixels.shape[:2]
    top, left = round((1 - share) * height / 2), round((1 - share) * width / 2)
    return np.ascontiguousarray(pixels[top : height - top, left : width - left])


def test_a_cut_frame_lies_where_it_was_cut_out() -> None:
    whole = scene(3)
    made = Framing(0.6, 0.6).applied(cut(whole, 0.6), 192, 144, None)
    assert made is not None
    pixels, mask = made
    assert pixels.shape == whole.shape and mask is not None
    assert (cut(pixels, 0.6) == cut(whole, 0.6)).all()
    hidden = mask.covered(240, 320)
    assert not cut(hidden, 0.6).any() and hidden.sum() == pytest.approx((1 - 0.36) * hidden.size, rel=0.01)


def test_a_frame_that_shows_more_is_cut() -> None:
    made = Framing(1.25, 1.25).applied(scene(3), 320, 240, None)
    assert made is not None and made[1] is None
    assert made[0].shape == (192, 256, 3) and (made[0] == scene(3)[24:216, 32:288]).all()


def test_a_portrait_fills_the_height() -> None:
    made = Framing(0.42, 1.0).applied(scene(3)[:, 93:227], 134, 240, None)
    assert made is not None and made[1] is not None
    rows, columns = made[0].shape[:2]
    assert columns / rows == pytest.approx(4 / 3, rel=0.02)
    hidden = made[1].covered(1, 100)[0]
    assert hidden[:28].all() and not hidden[30:70].any() and hidden[72:].all()


def test_the_mask_of_a_camera_goes_with_its_frame() -> None:
    bonnet = Mask(polygons=(((0.0, 0.5), (1.0, 0.5), (1.0, 1.0), (0.0, 1.0)),))
    made = Framing(0.8, 0.8).applied(scene(3), 320, 240, bonnet)
    assert made is not None and made[1] is not None
    middle = made[1].covered(20, 20)[:, 10]
    assert middle.tolist() == [row < 2 or row >= 10 for row in range(20)]
    assert Framing(1.25, 1.25).applied(scene(3), 320, 240, bonnet) is None  # its edge would not be known


def test_too_little_of_a_view_is_not_compared() -> None:
    assert Framing(0.3, 0.3).applied(scene(3), 320, 240, None) is None


def test_positions_are_those_of_the_frame() -> None:
    shares = Framing(0.6, 0.5).in_frame(np.array([[0.5, 0.5], [0.2, 0.25], [0.8, 0.75]]))
    assert np.allclose(shares, np.array([[0.5, 0.5], [0, 0], [1, 1]]))
    assert SAME_VIEW.zoomed(0.98).is_like(SAME_VIEW) and not SAME_VIEW.zoomed(0.9).is_like(SAME_VIEW)
