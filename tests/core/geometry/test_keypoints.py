"""Keypoints of a frame, as they are found and as a place keeps them."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import InvalidKeypoints
from core.evaluation.samples import sample_frame
from core.frames.masks import Mask
from core.geometry.keypoints import MOST, RESOLUTION, ROW, SHARES, Keypoints, find_keypoints, keypoints_of, shown_size
from core.networks.xfeat import LENGTH, XFeat, load_xfeat


@pytest.fixture(scope="module")
def network() -> XFeat:
    return load_xfeat()


@pytest.fixture(scope="module")
def found(network: XFeat) -> Keypoints:
    return find_keypoints(network, sample_frame())


def test_a_place_takes_at_most_40_kb() -> None:
    assert ROW.itemsize <= 40_000


def test_a_frame_has_keypoints_with_descriptors_of_unit_length(found: Keypoints) -> None:
    assert 300 < len(found) <= MOST and (found.width, found.height) == (640, 480)
    lengths = np.linalg.norm(found.descriptors.astype(np.float64), axis=1) / RESOLUTION
    assert 0.9 < lengths.min() <= lengths.max() < 1.05
    pixels = found.pixels()
    assert pixels.min() >= 0 and pixels[:, 0].max() < 640 and pixels[:, 1].max() < 480
    assert not found.positions.flags.writeable and not found.descriptors.flags.writeable


def test_keypoints_lie_on_the_corners_of_what_is_drawn(network: XFeat) -> None:
    """A pixel of the network is 1.3 wide here; there is no offset to one side."""
    frame = np.full((480, 640, 3), 40, np.uint8)
    corners = []
    for left in (30, 190, 350, 510):
        for top in (40, 190, 340):
            cv2.rectangle(frame, (left, top), (left + 79, top + 69), (210, 200, 220), -1)
            corners += [(x, y) for x in (left, left + 80) for y in (top, top + 70)]
    pixels = find_keypoints(network, cv2.GaussianBlur(frame, (0, 0), 1).astype(np.uint8)).pixels()
    offsets = pixels[None] - np.array(corners)[:, None]
    nearest = offsets[np.arange(len(corners)), np.linalg.norm(offsets, axis=2).argmin(axis=1)]
    assert np.median(np.linalg.norm(nearest, axis=1)) < 5
    assert np.abs(nearest.mean(axis=0)).max() < 1.3


@pytest.mark.parametrize(
    ("width", "height", "shown"),
    [
        (640, 480, (480, 352)),
        (160, 120, (480, 352)),
        (240, 192, (480, 384)),
        (480, 640, (352, 480)),
        (4000, 20, (480, 32)),
        (16, 16, (480, 480)),
    ],
)
def test_the_network_sees_a_side_of_480(network: XFeat, width: int, height: int, shown: tuple[int, int]) -> None:
    assert shown_size(width, height) == shown
    made = find_keypoints(network, sample_frame(1, width, height))
    assert (made.width, made.height) == (width, height)


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_blank_frame_has_none(network: XFeat, level: int) -> None:
    made = find_keypoints(network, np.full((120, 160, 3), level, np.uint8))
    assert len(made) == 0 and made.descriptors.shape == (0, LENGTH)
    assert len(keypoints_of(made.row())) == 0


def test_a_mask_hides_keypoints(network: XFeat) -> None:
    mask = Mask(polygons=(((0, 0), (0.5, 0), (0.5, 1), (0, 1)),))
    made = find_keypoints(network, sample_frame(), mask)
    assert len(made) > 50 and made.positions[:, 0].min() >= SHARES // 2 - SHARES // 100


def test_the_same_frame_gives_the_same_keypoints(network: XFeat, found: Keypoints) -> None:
    again = find_keypoints(network, sample_frame())
    assert np.array_equal(again.positions, found.positions) and np.array_equal(again.descriptors, found.descriptors)


def test_a_row_gives_back_what_was_put_into_it(found: Keypoints) -> None:
    read = keypoints_of(np.frombuffer(found.row().tobytes(), ROW)[0])
    assert (read.width, read.height) == (found.width, found.height)
    assert np.array_equal(read.positions, found.positions) and np.array_equal(read.descriptors, found.descriptors)


Change = Callable[[NDArray[np.void]], None]


def put(field: str, value: int, where: tuple[int, ...] | None = None) -> Change:
    def change(row: NDArray[np.void]) -> None:
        if where is None:
            row[field] = value
        else:
            row[field][where] = value

    return change


DAMAGES = {
    "too many": put("count", MOST + 1),
    "fewer than there are": put("count", 3),
    "more than there are": put("count", 12),
    "no width": put("width", 0),
    "no height": put("height", 0),
    "something behind": put("descriptors", 1, (MOST - 1, 5)),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_row_is_refused(found: Keypoints, damage: Change) -> None:
    few = Keypoints(found.width, found.height, found.positions[:10], found.descriptors[:10])
    row = np.array(few.row())
    assert len(keypoints_of(row)) == 10
    damage(row)
    with pytest.raises(InvalidKeypoints):
        keypoints_of(row)


def test_a_record_of_another_type_is_refused() -> None:
    with pytest.raises(InvalidKeypoints, match="bytes"):
        keypoints_of(np.zeros((), np.dtype([("count", "<u2")])))


@pytest.mark.parametrize(
    ("positions", "descriptors"),
    [
        (np.zeros((3, 2), np.uint16), np.zeros((2, LENGTH), np.int8)),
        (np.zeros((3, 3), np.uint16), np.zeros((3, LENGTH), np.int8)),
        (np.zeros((3, 2), np.float32), np.zeros((3, LENGTH), np.int8)),
        (np.zeros((3, 2), np.uint16), np.zeros((3, LENGTH), np.uint8)),
        (np.zeros((MOST + 1, 2), np.uint16), np.zeros((MOST + 1, LENGTH), np.int8)),
    ],
)
def test_arrays_that_are_no_keypoints_are_refused(positions: NDArray[np.uint16], descriptors: NDArray[np.int8]) -> None:
    with pytest.raises(InvalidKeypoints):
        Keypoints(640, 480, positions, descriptors)
