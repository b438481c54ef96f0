"""Keypoints of a frame, as they are found and as a place keeps them."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import InvalidKeypoints
from core.frames.masks import Mask
from core.geometry.detection import find_keypoints, shown_size
from core.geometry.keypoints import LENGTH, MOST, MOST_STORED, RESOLUTION, SHARES, Keypoints, keypoints_of, record_bytes
from core.networks.xfeat import XFeat, load_xfeat
from service.commands.timing.samples import sample_frame


@pytest.fixture(scope="module")
def network() -> XFeat:
    return load_xfeat()


@pytest.fixture(scope="module")
def found(network: XFeat) -> Keypoints:
    return find_keypoints(network, sample_frame())


def test_a_place_takes_at_most_40_kb() -> None:
    assert record_bytes(MOST) <= 27_000


def test_a_frame_has_keypoints_with_descriptors_of_unit_length(found: Keypoints) -> None:
    assert 300 < len(found) <= MOST and (found.width, found.height) == (640, 480)
    lengths = np.linalg.norm(found.descriptors.astype(np.float64), axis=1) / RESOLUTION
    assert 0.9 < lengths.min() <= lengths.max() < 1.05
    pixels = found.pixels()
    assert pixels.min() >= 0 and pixels[:, 0].max() < 640 and pixels[:, 1].max() < 480
    assert not found.positions.flags.writeable and not found.descriptors.flags.writeable


def test_keypoints_lie_on_the_corners_of_what_is_drawn(network: XFeat) -> None:
    """A pixel of the network is two wide here; there is no offset to one side."""
    frame = np.full((480, 640, 3), 40, np.uint8)
    corners = []
    for left in (30, 190, 350, 510):
        for top in (40, 190, 340):
            cv2.rectangle(frame, (left, top), (left + 79, top + 69), (210, 200, 220), -1)
            corners += [(x, y) for x in (left, left + 80) for y in (top, top + 70)]
    pixels = find_keypoints(network, cv2.GaussianBlur(frame, (0, 0), 1).astype(np.uint8)).pixels()
    offsets = pixels[None] - np.array(corners)[:, None]
    nearest = offsets[np.arange(len(corners)), np.linalg.norm(offsets, axis=2).argmin(axis=1)]
    assert np.median(np.linalg.norm(nearest, axis=1)) < 7.5
    assert np.abs(nearest.mean(axis=0)).max() < 2


@pytest.mark.parametrize(
    ("width", "height", "shown"),
    [
        (640, 480, (320, 256)),
        (160, 120, (320, 256)),
        (240, 192, (320, 256)),
        (480, 640, (256, 320)),
        (4000, 20, (960, 32)),
        (1226, 370, (512, 160)),
        (16, 16, (288, 288)),
    ],
)
def test_the_network_sees_320_by_240_pixels(network: XFeat, width: int, height: int, shown: tuple[int, int]) -> None:
    assert shown_size(width, height) == shown
    made = find_keypoints(network, sample_frame(1, width, height))
    assert (made.width, made.height) == (width, height)


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_blank_frame_has_none(network: XFeat, level: int) -> None:
    made = find_keypoints(network, np.full((120, 160, 3), level, np.uint8))
    assert len(made) == 0 and made.descriptors.shape == (0, LENGTH)
    assert len(keypoints_of(made.record())) == 0


def test_a_mask_hides_keypoints(network: XFeat) -> None:
    mask = Mask(polygons=(((0, 0), (0.5, 0), (0.5, 1), (0, 1)),))
    made = find_keypoints(network, sample_frame(), mask)
    assert len(made) > 50 and made.positions[:, 0].min() >= SHARES // 2 - SHARES // 100


def test_the_same_frame_gives_the_same_keypoints(network: XFeat, found: Keypoints) -> None:
    again = find_keypoints(network, sample_frame())
    assert np.array_equal(again.positions, found.positions) and np.array_equal(again.descriptors, found.descriptors)


def test_a_record_gives_back_what_was_put_into_it(found: Keypoints) -> None:
    record = found.record()
    assert len(record) == record_bytes(len(found))
    read = keypoints_of(record)
    assert (read.width, read.height) == (found.width, found.height)
    assert np.array_equal(read.positions, found.positions) and np.array_equal(read.descriptors, found.descriptors)


def put(offset: int, *values: int) -> Callable[[bytearray], object]:
    def change(record: bytearray) -> None:
        record[offset : offset + len(values)] = bytes(values)

    return change


DAMAGES: dict[str, Callable[[bytearray], object]] = {
    "nothing": bytearray.clear,
    "a part of the header": lambda record: record.__delitem__(slice(11, None)),
    "too many": put(8, 0, 3),
    "fewer than there are": put(8, 3),
    "more than there are": put(8, 12),
    "no width": put(0, 0, 0, 0, 0),
    "no height": put(4, 0, 0, 0, 0),
    "a byte less": bytearray.pop,
    "a byte more": lambda record: record.append(1),
    "no descriptor": put(12 + 40 + 3 * LENGTH, *[0] * LENGTH),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_record_is_refused(found: Keypoints, damage: Callable[[bytearray], object]) -> None:
    few = Keypoints(found.width, found.height, found.positions[:10], found.descriptors[:10])
    record = bytearray(few.record())
    assert len(keypoints_of(bytes(record))) == 10
    damage(record)
    with pytest.raises(InvalidKeypoints):
        keypoints_of(bytes(record))


def test_more_keypoints_than_a_frame_has_are_refused() -> None:
    with pytest.raises(InvalidKeypoints):
        keypoints_of(bytes([1, 0, 0, 0] * 2 + [65, 2, 0, 0]) + b"\1" * (68 * (MOST_STORED + 1)))


@pytest.mark.parametrize(
    ("positions", "descriptors"),
    [
        (np.zeros((3, 2), np.uint16), np.zeros((2, LENGTH), np.int8)),
        (np.zeros((3, 3), np.uint16), np.zeros((3, LENGTH), np.int8)),
        (np.zeros((3, 2), np.float32), np.zeros((3, LENGTH), np.int8)),
        (np.zeros((3, 2), np.uint16), np.zeros((3, LENGTH), np.uint8)),
        (np.zeros((MOST_STORED + 1, 2), np.uint16), np.zeros((MOST_STORED + 1, LENGTH), np.int8)),
    ],
)
def test_arrays_that_are_no_keypoints_are_refused(positions: NDArray[np.uint16], descriptors: NDArray[np.int8]) -> None:
    with pytest.raises(InvalidKeypoints):
        Keypoints(640, 480, positions, descriptors)
