"""Masks: which cells of a grid they cover, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from core.frames.masks import Mask

Box = tuple[float, float, float, float]


def box(left: float, top: float, right: float, bottom: float) -> tuple[tuple[float, float], ...]:
    return ((left, top), (right, top), (right, bottom), (left, bottom))


def test_the_bonnet_covers_the_lower_quarter() -> None:
    covered = Mask(polygons=(box(0, 0.75, 1, 1),)).covered(8, 4)
    assert covered[6:].all() and not covered[:6].any()


def test_a_cell_counts_from_half_of_its_area() -> None:
    mask = Mask(polygons=(box(0, 0, 0.16, 0.49),))
    assert mask.covered(1, 4).tolist() == [[False] * 4]
    assert Mask(polygons=(box(0, 0, 0.16, 0.9),)).covered(1, 4).tolist() == [[True, False, False, False]]


@given(st.tuples(st.floats(0, 0.8), st.floats(0, 0.8), st.floats(0.1, 0.7), st.floats(0.1, 0.7)))
def test_the_area_covered_is_that_of_the_box(shape: Box) -> None:
    left, top, width, height = shape
    right, bottom = min(1.0, left + width), min(1.0, top + height)
    shares = Mask(polygons=(box(left, top, right, bottom),)).shares(16, 16)
    # Edges fall on a grid eight times finer than the cells, and OpenCV fills the pixels that it touches.
    assert shares.mean() == pytest.approx((right - left) * (bottom - top), abs=0.03)


def test_what_two_polygons_both_hold_stays_covered() -> None:
    both = Mask(polygons=(box(0, 0, 0.6, 0.6), box(0.2, 0.2, 0.8, 0.8))).covered(10, 10)
    assert both[3:5, 3:5].all()


def test_the_shares_cannot_be_written_to() -> None:
    with pytest.raises(ValueError):
        Mask(polygons=(box(0, 0, 0.5, 0.5),)).shares(4, 4)[:] = 0


def test_equal_masks_have_equal_digests_and_others_not() -> None:
    one, same = Mask(polygons=(box(0, 0, 0.5, 0.5),)), Mask.model_validate({"polygons": [box(0, 0, 0.5, 0.5)]})
    assert one == same and one.digest == same.digest and len(one.digest) == 64
    assert one.digest != Mask(polygons=(box(0, 0, 0.5, 0.6),)).digest


@pytest.mark.parametrize(
    "polygons",
    [
        [],
        [[(0, 0), (1, 1)]],
        [[(0, 0), (1, 0), (1, 1.5)]],
        [[(0, 0), (1, 0), (float("nan"), 1)]],
        [box(0, 0, 1, 0.95)],
        [box(0, 0, 0.1, 0.1)] * 65,
        [[(i / 300, 0.5) for i in range(257)]],
    ],
)
def test_what_no_mask_can_be_is_refused(polygons: object) -> None:
    with pytest.raises(ValidationError):
        Mask.model_validate({"polygons": polygons})


def test_nothing_is_covered_where_nothing_is_drawn() -> None:
    assert np.count_nonzero(Mask(polygons=(box(0.9, 0.9, 1, 1),)).covered(4, 4)) == 0
