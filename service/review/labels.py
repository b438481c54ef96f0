"""The labelled frames of a map as queries with known truth, for its calibration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from core.errors import PlacerecError, StorageFailure, UnknownCamera
from core.frames.masks import Mask
from core.places import look_address
from core.store import Map
from service.engine.encoders import Encoded
from service.engine.engine import Engine
from service.learning.adoption import LEARNING
from service.places.place_events import tell_change

TOGETHER = 32
"""Number of frames that are read and encoded at a time."""


@dataclass(frozen=True)
class KnownFrame:
    """A frame stored for review whose place is known, or known to be absent.

    number: of the frame.
    camera: the camera that took it, as the query named it.
    place: the id of the place that it shows; None if the map has none.
    own: the place as which it was enrolled, or the address of the look; None: it is in no map.
    """

    number: int
    camera: str | None
    place: str | None
    own: str | None


def known_frames(map_: Map, most: int) -> tuple[list[KnownFrame], int]:
    """The latest labelled frames of a map, at most ``most``, and how many were left out as their places are gone.

    Raises:
        StorageFull, StorageFailure.
    """
    found = []
    for frame in map_.review.labelled():
        if str((frame.label or {}).get("by")).startswith(LEARNING):
            continue  # a map is not calibrated by its own conclusions
        label = (frame.label or {})["label"]
        camera, place = frame.answer.get("camera"), label.get("place") or label.get("new")
        own = label.get("new")
        if place is not None and (look := label.get("look")) is not None:
            own = look_address(place, look)
        found.append(KnownFrame(frame.number, camera, place, own))
    found = found[-most:]
    named = [frame.place for frame in found if frame.place is not None]
    there = {place for place, row in zip(named, map_.rows_of(named), strict=True) if row is not None}
    usable = [frame for frame in found if frame.place is None or frame.place in there]
    return usable, len(found) - len(usable)


def withdraw_contradicted(
    engine: Engine, map_: Map, before: Mapping[str, Any] | None, label: Mapping[str, Any]
) -> None:
    """Withdraw the look that a map has taken by itself from a frame of which a person says that it shows another place.

    Args:
        before: the label that the frame had, and who gave it; None: it had none.
        label: what the person says.

    Raises:
        StorageFull, StorageFailure.
    """
    if before is None or not str(before.get("by")).startswith(LEARNING):
        return
    place, look = before["label"]["place"], before["label"].get("look")
    if look is not None and label.get("place") != place:
        (row,) = map_.rows_of([look_address(place, look)])
        tell_change(engine, map_, "look-removed", map_.withdraw([] if row is None else [row]))


Part = tuple[list[KnownFrame], list[bytes], list[Mask | None]]
"""Some frames, their files, and the masks of their cameras."""


def parts(map_: Map, frames: Sequence[KnownFrame]) -> Iterator[Part]:
    """The frames some at a time, without those that are gone or damaged.

    Reading blocks, so take each part in a thread.
    """
    for start in range(0, len(frames), TOGETHER):
        some, files, masks = [], [], []
        for frame in frames[start : start + TOGETHER]:
            with suppress(PlacerecError):
                files.append(map_.review.picture(frame.number))
                some.append(frame)
                masks.append(_mask(map_, frame.camera))
        yield some, files, masks


def _mask(map_: Map, camera: str | None) -> Mask | None:
    try:
        return map_.cameras.mask(camera)
    except (UnknownCamera, StorageFailure):
        return None


def with_regions(
    frames: Sequence[KnownFrame], outcomes: Sequence[Encoded | Exception]
) -> list[tuple[KnownFrame, Encoded]]:
    """The frames that were encoded and have regions; others cannot be searched for."""
    return [
        (frame, outcome)
        for frame, outcome in zip(frames, outcomes, strict=True)
        if not isinstance(outcome, Exception) and len(outcome.encoding.regions)
    ]
