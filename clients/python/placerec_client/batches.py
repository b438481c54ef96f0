"""Batches of frames: their input, the outcome of each, and the bounds of a batch."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from placerec_client import models, problems
from placerec_client.errors import (
    InvalidFrame,
    InvalidName,
    InvalidParameter,
    PlacerecError,
    Problem,
    UnexpectedAnswer,
)
from placerec_client.frames import Frame, frame_bytes, shown
from placerec_client.requests import dumps, fields, name_of

FIRST_BATCH, LARGEST_BATCH, FASTEST_GROWTH = 16, 128, 8
BATCH_BYTES = 16 * 1024 * 1024
"""A batch ends with the frame that reaches this size; two batches, their forms and the next are in memory at once."""

BATCH_SECONDS = 4.0
"""How long a batch should take: long compared with its fixed costs, short compared with the service's time limit."""

KNOWN_AT_ONCE = 128
"""Most frames whose digests one request asks about."""

PATIENCE = 120.0
"""Seconds for which a batch is repeated while the service is overloaded or restarts, if the client has any patience."""

OF_THE_FRAME = frozenset({400, 413, 415, 422})
"""Statuses that concern one frame; with any other status the remaining frames would most likely fail as well."""

TOO_SLOW = frozenset({"deadline-exceeded"})
"""Problems that a batch would have again, but a smaller one might not."""

OUT_OF_ORDER = problems.BatchOutOfOrder
"""The problem of a batch whose predecessor is not stored."""

PLACE_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._~-]{0,127}")
"""The pattern of the id of a place. It also names the frame's part of a form, which cannot be any text."""


@dataclass(frozen=True)
class NewPlace:
    """A frame that is to be enrolled.

    Args:
        id: of its place.
        frame: the frame, or a function that returns it when its turn has come, so that it need not be in memory before.
        fields: of the place, such as ``x``, ``y``, ``heading``, ``sequence``, ``timestamp``, ``camera``, ``metadata``;
            or a function that returns them for the bytes of the frame.
    """

    id: str
    frame: Frame | Callable[[], Frame]
    fields: Mapping[str, Any] | Callable[[bytes], Mapping[str, Any]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.id!r}, {shown(self.frame)}, {self.fields!r})"


@dataclass(frozen=True)
class Enrolled:
    """The outcome of one frame.

    Attributes:
        place: the frame to enrol.
        change: ``created``, ``replaced``, ``updated`` or ``unchanged``; None if the frame was refused.
        error: why it was refused.
        view: the place as the service has it.
        fields: those that were sent of it.
        uploaded: whether its bytes were sent; otherwise the service had them, or they could not be read.
    """

    place: NewPlace
    change: str | None
    error: PlacerecError | None = None
    view: models.PlaceView | None = None
    fields: Mapping[str, Any] = field(default_factory=dict)
    uploaded: bool = True


@dataclass(frozen=True)
class Located:
    """The answer to one frame of many; ``error`` says why there is none."""

    frame: Frame
    answer: models.QueryAnswer | None
    error: PlacerecError | None = None

    def __repr__(self) -> str:
        outcome = f"answer={self.answer!r}" if self.error is None else f"error={self.error!r}"
        return f"{type(self).__name__}({shown(self.frame)}, {outcome})"


@dataclass(frozen=True)
class Read:
    """A frame that was read; ``data`` is empty if only its digest is sent, or if there is an ``error``: nothing is."""

    place: NewPlace
    entry: dict[str, Any] = field(default_factory=dict)
    data: bytes = b""
    error: PlacerecError | None = None

    @property
    def fields(self) -> dict[str, Any]:
        """The fields of the entry."""
        return {name: value for name, value in self.entry.items() if name not in ("id", "file", "sha256")}


def read_place(place: NewPlace, digest: bool = False) -> Read:
    """Read a frame and make its entry; with ``digest`` only the digest of its bytes is held.

    Raises:
        InvalidParameter: the place is none; the fault of one is its ``error``.
    """
    if not isinstance(place, NewPlace):
        raise InvalidParameter(f"A frame to enrol has to be a NewPlace, not a {type(place).__name__}.")
    try:
        if not PLACE_ID.fullmatch(name_of(place.id)):
            raise InvalidName(
                place.id,
                "the id of a place has 1 to 128 characters, letters of ASCII, digits and . _ ~ -, and begins with a "
                "letter or a digit",
            )
        data = frame_bytes(place.frame() if callable(place.frame) else place.frame)
        given = place.fields(data) if callable(place.fields) else place.fields
        entry = {"id": place.id, **{name: value for name, value in fields(given).items() if value is not None}}
        dumps(entry)
    except (InvalidName, InvalidParameter, InvalidFrame) as error:
        return Read(place, error=error)
    if digest:
        return Read(place, {**entry, "sha256": hashlib.sha256(data).hexdigest()})
    return Read(place, {**entry, "file": place.id}, data)


def outcome_of(read: Read, item: models.BatchResult | None, error: PlacerecError | None, uploaded: bool) -> Enrolled:
    """The outcome of a frame, from the service's answer, or without one."""
    if item is None or item.change is None:
        return Enrolled(
            read.place, None, error or read.error, fields=read.fields, uploaded=uploaded and read.error is None
        )
    return Enrolled(read.place, item.change, view=item.place, fields=read.fields, uploaded=uploaded)


class Pace:
    """The size of the next batch: as many frames as take about BATCH_SECONDS, within what the service accepts."""

    def __init__(self) -> None:
        self.frames, self._most = FIRST_BATCH, LARGEST_BATCH

    def took(self, frames: int, seconds: float) -> None:
        """Adapt to the time that a batch has taken."""
        rate = frames / max(seconds, 1e-3)
        self.frames = max(1, min(self._most, int(rate * BATCH_SECONDS), FASTEST_GROWTH * self.frames))

    def halve(self, frames: int) -> int:
        """Keep to half of a batch that was too large; return that half."""
        self._most = self.frames = max(1, frames // 2)
        return self._most


def too_large(error: Problem | UnexpectedAnswer, frames: int) -> bool:
    """Whether a batch failed for what a smaller one might not; a form with these statuses is too large."""
    slug = getattr(error, "slug", "")
    return frames > 1 and (error.status in OF_THE_FRAME or slug in TOO_SLOW)
