"""Frames that a map stores because its answers were doubtful, and people's labels of them."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Protocol

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


class Review(Protocol):
    """The frames of one map stored for review.  Any thread may use it; every method may raise StorageFull
    and StorageFailure."""

    def keep(self, data: bytes, answer: Mapping[str, Any], setting: ReviewSetting, renew: bool = False) -> bool:
        """Keep a frame, and drop the oldest ones beyond the limits; it is durable when this returns.

        Args:
            renew: if the same file is stored already, and has no label, it gets this answer in place of its former one.

        Returns:
            Whether it was stored: not if the same file is stored already, or is larger than all frames may be together.
        """

    def shrink(self, setting: ReviewSetting) -> None:
        """Drop the oldest frames beyond new limits, and give back the room."""

    def drop_before(self, moment: datetime) -> int:
        """Drop the frames that were asked before a moment, with their labels; returns how many.

        A map that is not open yet is not opened for this.
        """

    def page(self, before: int | None, limit: int, labelled: bool | None = None) -> StoredReviews:
        """The latest frames, newest first, and how many are stored in all, as of one moment.

        Args:
            before: only frames with a smaller number; None: all.
            labelled: only frames with a label, or without one; None: all.
        """

    def labelled(self) -> list[ReviewFrame]:
        """All frames with a label, oldest first."""

    def find(self, number: int) -> ReviewFrame:
        """One frame.

        Raises:
            UnknownFrame: it is not stored.
        """

    def picture(self, number: int) -> bytes:
        """The file of a frame.

        Raises:
            UnknownFrame: it is not stored.
            StorageFailure: it is damaged.
        """

    def held(self, number: int) -> AbstractContextManager[None]:
        """Protect a frame, if it is stored, from being dropped for newer ones until the block ends; one at a time.

        This waits for nothing.
        """

    def label(self, number: int, label: Mapping[str, Any] | None) -> ReviewFrame:
        """Label a frame; the label replaces an earlier one, and None takes it back.

        Raises:
            UnknownFrame: it is not stored.
        """

    def label_first(self, number: int, label: Mapping[str, Any]) -> bool:
        """Label a frame that has no label, whoever else labels it at the same time; whether it had none.

        Raises:
            UnknownFrame: it is not stored.
        """

    def discard(self, number: int) -> None:
        """Throw a frame away.

        Raises:
            UnknownFrame: it is not stored.
        """


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


PAGE = 500
"""Frames that are read at a time."""


def stored_frames(
    review: Review, labelled: bool | None = None, look: Callable[[], None] = lambda: None
) -> Iterator[ReviewFrame]:
    """All frames that a map has stored for review, the newest first; those that are read may be discarded meanwhile.

    Args:
        labelled: only frames with a label, or without one; None: all.
        look: is called before each page.
    """
    before: int | None = None
    while True:
        look()
        page = review.page(before, PAGE, labelled).frames
        yield from page
        if len(page) < PAGE:
            return
        before = page[-1].number
