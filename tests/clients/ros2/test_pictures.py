"""From a camera's messages to pixels and files; the pixel formats are in ``tests/core/frames``."""

from __future__ import annotations

from array import array
from types import SimpleNamespace

import numpy as np
import pytest

from placerec_ros.pictures import UnfitPicture, picture_of
from tests.clients.ros2.ros_messages import image
from tests.service.scenes import encoded, scene

PICTURE = scene(5, 64, 48)


def test_rows_may_have_padding() -> None:
    padded = np.zeros((48, 200), np.uint8)
    padded[:, :192] = PICTURE.reshape(48, 192)
    np.testing.assert_array_equal(picture_of(image("bgr8", 64, 48, padded.tobytes(), step=200)), PICTURE)
    last_row_short = padded.tobytes()[:-8]
    np.testing.assert_array_equal(picture_of(image("bgr8", 64, 48, last_row_short, step=200)), PICTURE)


@pytest.mark.parametrize("extension", [".jpg", ".png", ".webp"])
def test_files_go_as_they_are(extension: str) -> None:
    data = encoded(PICTURE, extension)
    assert picture_of(SimpleNamespace(format="whatever", data=array("B", data))) == data


@pytest.mark.parametrize("data", [b"", b"\0\0\0\1\x67video", b"RIFF    WAVE"])
def test_files_of_other_formats_are_refused(data: bytes) -> None:
    with pytest.raises(UnfitPicture, match="the format 'other' holds no JPEG, PNG or WebP file"):
        picture_of(SimpleNamespace(format="other", data=data))
