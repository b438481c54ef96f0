"""Pictures of 16 bits that use a part of them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from core.frames.images import decode
from core.frames.value_ranges import ValueRange, few_values, range_of, scaled, told
from tests.service.scenes import encoded, scene

GREY = cv2.cvtColor(scene(1), cv2.COLOR_BGR2GRAY)
TEN = encoded(GREY.astype(np.uint16) * 4, ".png")
THERMAL = encoded(GREY.astype(np.uint16) * 8 + 20_000, ".png")
FULL = encoded(scene(1).astype(np.uint16) * 257, ".png")


def test_the_ends_of_a_range_are_black_and_white_and_what_is_beyond_is_as_they_are() -> None:
    values = np.array([[0, 100, 101, 300, 500, 501, 65535]], np.uint16)
    assert scaled(values, (100, 500)).tolist() == [[0, 0, 1, 128, 255, 255, 255]]
    assert scaled(values, (0, 65535)).tolist() == [[0, 0, 0, 1, 2, 2, 255]]


@pytest.mark.parametrize(("data", "values"), [(TEN, (0, 1020)), (THERMAL, (20_000, 22_040))])
def test_a_picture_is_decoded_by_the_range_of_its_camera(data: bytes, values: tuple[int, int]) -> None:
    grey = decode(data, value_range=values)
    assert grey.shape == (*GREY.shape, 3) and np.array_equal(grey, cv2.cvtColor(GREY, cv2.COLOR_GRAY2BGR))
    assert np.ptp(decode(data)) < 10  # without it nearly nothing is left


@pytest.mark.parametrize("data", [encoded(scene(1)), encoded(scene(1), ".png"), encoded(scene(1), ".webp")])
def test_a_range_changes_nothing_of_8_bits(data: bytes) -> None:
    assert np.array_equal(decode(data, value_range=(0, 1023)), decode(data))


def test_colours_of_16_bits() -> None:
    assert np.array_equal(decode(FULL), scene(1))  # as ever, the upper 8 bits
    assert np.array_equal(decode(FULL, value_range=(0, 65535)), scene(1))


def test_few_values_are_noticed() -> None:
    assert few_values(TEN) == (4 * int(GREY.min()), 4 * int(GREY.max()))
    assert told((8, 1020)) == "reach only 1020 of 65535"
    found = few_values(THERMAL)
    assert found is not None and told(found).startswith(f"lie between {found[0]} and {found[1]} of 65535")
    for none in (FULL, encoded(GREY, ".png"), encoded(GREY), encoded(np.full_like(GREY, 9, np.uint16), ".png"), b"?"):
        assert few_values(none) is None
    assert few_values(TEN[:200]) is None  # damaged


def test_the_range_of_a_recording_leaves_out_what_hardly_any_pixel_has() -> None:
    hot = GREY.astype(np.uint16) * 4
    hot[0, :3] = 65535
    found = range_of([TEN, encoded(hot, ".png"), encoded(GREY)])
    assert found is not None and found[1] <= 1020 and abs(found[0] - 4 * int(GREY.min())) <= 8
    assert range_of([FULL]) is None and range_of([encoded(GREY, ".png")]) is None and range_of([]) is None


@pytest.mark.parametrize("wrong", [[5, 5], [9, 3], [-1, 9], [0, 65536], [0.0, 9], [1], "9", [True, 3]])
def test_what_is_no_range(wrong: Any) -> None:
    with pytest.raises(ValidationError):
        TypeAdapter(ValueRange).validate_python(wrong)
