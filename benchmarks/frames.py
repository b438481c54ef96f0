"""Frames to measure with: those of a robot's camera, and folders of them encoded."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from core.frames.images import decode
from core.frames.traverses import find_images
from core.method.encoder import Encoder, Encoding
from service.commands.timing.samples import jpeg, sample_frame

WIDTH, HEIGHT = 640, 480
BATCH = 8
REAL = Path(__file__).parents[2] / "shared" / "datasets" / "eval" / "lip6_outdoor"


def camera_frames(count: int, traverse: str = "query") -> tuple[list[bytes], str]:
    """``count`` JPEG files of 640 x 480, and their name: lip6_outdoor enlarged, or drawn where that is absent.

    Args:
        traverse: ``query`` or ``reference``; sample frames differ between the two as well.
    """
    folder = REAL / traverse
    if not folder.is_dir():
        first = 0 if traverse == "query" else 10_000
        return [jpeg(sample_frame(first + index, WIDTH, HEIGHT)) for index in range(count)], "sample frames"
    paths = find_images(folder)
    made = []
    for index in range(count):
        small = decode(paths[index * max(1, len(paths) // count) % len(paths)].read_bytes())
        large = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        made.append(jpeg(np.asarray(large, np.uint8)))
    return made, "lip6_outdoor, enlarged"


def encode_folder(encoder: Encoder, folder: Path) -> list[Encoding]:
    """The encodings of all images of a folder, in natural order."""
    frames = [decode(path.read_bytes()) for path in find_images(folder)]
    batches = (frames[start : start + BATCH] for start in range(0, len(frames), BATCH))
    return [encoding for batch in batches for encoding in encoder.encode_batch(batch)]
