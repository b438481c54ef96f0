"""Forms with many frames: how their entries are read, and which errors concern one frame or the whole request."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection
from typing import Any

from starlette.requests import Request

from core import errors
from core.maps.cameras import KnownCameras
from core.places import check_place_id
from service.errors.faults import (
    Fault,
    FrameNeeded,
    ImplausiblePose,
    InvalidRequest,
    PlacesTaken,
    UnsupportedMediaType,
)
from service.errors.problems import Problem, request_problem
from service.http.multipart import FormPart
from service.http.schemas import validated
from service.http.uploads import check_part
from service.places.enrolment import FrameToEnrol
from service.places.parameters import BatchItem
from service.settings import Settings

FRAME_ERRORS = (
    errors.InvalidImage,
    errors.NoRegions,
    errors.InvalidIdentifier,
    errors.InvalidField,
    errors.MixedCoordinates,
    errors.UnknownCamera,
    FrameNeeded,
    PlacesTaken,
    InvalidRequest,
    ImplausiblePose,
    UnsupportedMediaType,
)

"""Errors that concern one frame of a batch; the other frames are still processed."""

log = logging.getLogger("placerec.batches")


def frame_problem(request: Request, error: Exception) -> Problem:
    """The problem of one frame of a batch, so that the other frames can go on.

    An unforeseen error counts as the frame's own.

    Raises:
        Fault, PlacerecError: ``error`` itself, if it concerns the whole request (a full queue or disk, a deadline, a
            damaged model).
    """
    check_frame_error(error, request.state.request_id)
    return request_problem(request, error)


def check_frame_error(error: Exception, request_id: str | None = None) -> None:
    """Raise an error that concerns the whole request; return if it concerns one frame.  Unforeseen errors are logged.

    Raises:
        Fault, PlacerecError: ``error`` itself.
    """
    if not isinstance(error, FRAME_ERRORS):
        if isinstance(error, (Fault, errors.PlacerecError)):
            raise error
        log.error("a frame of a batch failed", exc_info=error, extra={"request_id": request_id})


def check_batch(entries: Any, names: list[str], most: int) -> None:
    """Check a form of many frames as a whole.

    Args:
        entries: the JSON value of its part ``places``.
        names: the names of its file parts.
        most: the largest number of places.

    Raises:
        InvalidRequest: the form has no places or too many, a name twice, or a file that no place uses.
    """
    if not isinstance(entries, list) or not entries:
        raise InvalidRequest("The part 'places' is not a JSON array with at least one place.")
    if len(entries) > most:
        raise InvalidRequest(f"The batch has {len(entries)} places; the limit is {most}.")
    if len(set(names)) != len(names):
        raise InvalidRequest("Two file parts have the same name.")
    wanted = {entry.get("file") for entry in entries if isinstance(entry, dict) and isinstance(entry.get("file"), str)}
    if spare := sorted(set(names) - wanted):
        raise InvalidRequest(f"No place of the batch names the file part {spare[0][:80]!r}.")


def read_entry(
    entry: Any, names: Collection[str], read: Callable[[str], FormPart], cameras: KnownCameras, settings: Settings
) -> FrameToEnrol:
    """The frame that one entry of a batch describes.

    Args:
        entry: one JSON value of the part ``places``.
        names: the names of the file parts.
        read: returns the file part of a name.
        cameras: of the map.

    Raises:
        InvalidRequest, InvalidIdentifier, InvalidField: the entry is malformed.
        UnknownCamera: the map has no such camera.
        InvalidImage, UnsupportedMediaType: the file is not an image that can be read.
    """
    item = validated(BatchItem, entry)
    check_place_id(item.id)
    fields = item.fields(item.metadata, settings)
    mask = cameras.mask(fields.camera)
    if item.file is None:
        return FrameToEnrol(item.id, fields, None, mask, sha256=bytes.fromhex(str(item.sha256)))
    if item.file not in names:
        raise InvalidRequest(f"file: the form has no part named {item.file[:80]!r}.")
    part = read(item.file)
    check_part(part, settings)
    return FrameToEnrol(item.id, fields, part.data, mask)


def entry_id(entry: Any) -> str | None:
    """The id of an entry of a batch, at most 200 characters; None if the entry has no text as its id."""
    given = entry.get("id") if isinstance(entry, dict) else None
    # JSON can escape half a surrogate pair, which an answer cannot contain.
    return given[:200].encode("utf-8", "replace").decode() if isinstance(given, str) else None
