"""The frames that the service is measured with, in the size of a robot's camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from core.evaluation.samples import jpeg, sample_frame
from core.frames.images import decode
from core.frames.traverses import find_images

WIDTH, HEIGHT = 640, 480
REAL = Path(__file__).parents[2] / "shared" / "datasets" / "eval" / "lip6_outdoor"


def camera_frames(count: int, traverse: str = "query") -> tuple[list[bytes], str]:
    """So many JPEG files of 640 x 480, and what they are: those of lip6_outdoor enlarged, or drawn where it is not.

    Args:
        traverse: ``query`` or ``reference``; drawn pictures differ between the two as well.
    """
    folder = REAL / traverse
    if not folder.is_dir():
        first = 0 if traverse == "query" else 10_000
        return [jpeg(sample_frame(first + index, WIDTH, HEIGHT)) for index in range(count)], "drawn pictures"
    paths = find_images(folder)
    made = []
    for index in range(count):
        small = decode(paths[index * max(1, len(paths) // count) % len(paths)].read_bytes())
        large = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        made.append(jpeg(np.asarray(large, np.uint8)))
    return made, "lip6_outdoor, enlarged"
