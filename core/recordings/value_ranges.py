"""The range of the values of a recording whose frames have 16 bits and use a part of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from core.errors import InvalidImage, InvalidRecording
from core.frames.value_ranges import ValueRange, has_16_bits, range_of, told
from core.recordings.frame import RecordedFrame

SAMPLE = 16
"""Frames of a recording that are measured, over its whole length."""


def used_range(frames: Sequence[RecordedFrame]) -> ValueRange | None:
    """The range of a recording's values, without a few at either end; None where the upper 8 bits show them.

    One frame is read of a recording whose frames have 8 bits.
    """
    return range_of(_sample(frames))


def _sample(frames: Sequence[RecordedFrame]) -> Iterator[bytes]:
    """The bytes of frames over the whole recording, while they have 16 bits."""
    for number in range(min(SAMPLE, len(frames))):
        try:
            data = frames[number * len(frames) // min(SAMPLE, len(frames))].load()
        except (InvalidImage, InvalidRecording, OSError):
            continue  # what is wrong with it is said where it is enrolled
        if not has_16_bits(data):
            return
        yield data


def range_remark(used: ValueRange, camera: str | None) -> str:
    """What is to be said of a recording that uses a part of 16 bits, and of its camera, which had no range before."""
    start = f"Its frames have 16 bits, whose values {told(used)}"
    if camera is None:
        return (
            f"{start}. Their upper 8 bits, which are used, show little: name a camera of the map, which gets this "
            "range if it has none."
        )
    low, high = used
    return (
        f"{start}. The camera {camera} had no range of values, and has {low} to {high} now, by which its frames are "
        "scaled."
    )
