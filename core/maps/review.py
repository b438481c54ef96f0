"""Frames that a map stores because its answers were doubtful, and people's labels of them."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from core.maps.records import ReviewSetting


@dataclass(frozen=True)
class ReviewFrame:
    """A frame stored for review, without its picture.

    number: counts the frames of the map; a later frame has a larger number.
    at: the time of the query, UTC.
    digest: the SHA-256 of the file, 32 bytes.
    size: of the file, in bytes.
    answer: how the map answered it; a JSON object.
    label: the place that it shows, who said so, and when; a JSON object.  None: it has no label.
    replaced: the label that its new label has replaced; None: it had none, or this is not known.
    """

    number: int
    at: datetime
    digest: bytes
    size: int
    answer: Mapping[str, Any]
    label: Mapping[str, Any] | None = None
    replaced: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class StoredReviews:
    """Some stored frames, and the number and bytes of all at that moment.

    frames: newest first.
    count, size: how many frames are stored in all, and their bytes.
    """

    frames: list[ReviewFrame]
    count: int
    size: int


def frames_to_drop(
    frames: Iterable[tuple[int, int]], count: int, size: int, setting: ReviewSetting, held: Container[int]
) -> list[int]:
    """The numbers of the frames to drop so that the limits hold; held ones stay.

    Args:
        frames: number and size of each, in the order in which they go: without a label first, then the oldest.
        count, size: how many there are, and their bytes.
    """
    going = []
    for number, bytes_ in frames:
        if setting.allows(count, size):
            break
        if number not in held:
            going.append(number)
            count, size = count - 1, size - bytes_
    return going
