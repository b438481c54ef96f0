"""Many frames in one request: which errors are one frame's own, and which end the whole request."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection
from typing import Any

from starlette.requests import Request

from core import errors
from core.places import check_place_id
from core.storage import Map
from service.errors.faults import Fault, FrameNeeded, InvalidRequest, UnsupportedMediaType
from service.errors.problems import Problem, request_problem
from service.http.multipart import Part
from service.http.schemas import validated
from service.http.uploads import check_part
from service.places.enrolment import Candidate
from service.places.parameters import BatchItem
from service.settings import Settings

OWN_ERRORS = (
    errors.InvalidImage,
    errors.NoRegions,
    errors.InvalidIdentifier,
    errors.InvalidField,
    errors.UnknownCamera,
    FrameNeeded,
    InvalidRequest,
    UnsupportedMediaType,
)

log = logging.getLogger("placerec.batches")


def item_problem(request: Request, error: Exception) -> Problem:
    """The problem of one frame, so that the others go on.

    An error that nobody foresaw counts as the frame's own: it is poisoned until shown otherwise.

    Raises:
        Fault, PlacerecError: ``error`` itself, where it is none of the frame (a full queue or disk, a
            deadline, a damaged model).
    """
    check_own(error, request.state.request_id)
    return request_problem(request, error)


def check_own(error: Exception, request_id: str | None = None) -> None:
    """Return if an error is one frame's own; one that nobody foresaw is logged.

    Raises:
        Fault, PlacerecError: ``error`` itself, where it is none of the frame.
    """
    if not isinstance(error, OWN_ERRORS):
        if isinstance(error, (Fault, errors.PlacerecError)):
            raise error
        log.error("a frame of a batch failed", exc_info=error, extra={"request_id": request_id})


def check_batch(entries: Any, names: list[str], most: int) -> None:
    """See that a form as a whole makes sense.

    Args:
        entries: value of its part ``places``.
        names: of its file parts.
        most: places.

    Raises:
        InvalidRequest: it does not.
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


def candidate_of(
    entry: Any, names: Collection[str], read: Callable[[str], Part], map_: Map, settings: Settings
) -> Candidate:
    """What is to be enrolled by one entry of a batch.

    Args:
        names: of the file parts.
        read: gives one of them.

    Raises:
        InvalidRequest, InvalidIdentifier, InvalidField, UnknownCamera, InvalidImage, UnsupportedMediaType.
    """
    item = validated(BatchItem, entry)
    check_place_id(item.id)
    fields = item.fields(item.metadata, settings)
    mask = map_.cameras.mask(fields.camera)
    if item.file is None:
        return Candidate(item.id, fields, None, mask, sha256=bytes.fromhex(str(item.sha256)))
    if item.file not in names:
        raise InvalidRequest(f"file: the form has no part named {item.file[:80]!r}.")
    part = read(item.file)
    check_part(part, settings)
    return Candidate(item.id, fields, part.data, mask)


def given_id(entry: Any) -> str | None:
    """The id that an entry of a batch names, if it is anything like one."""
    given = entry.get("id") if isinstance(entry, dict) else None
    # Half a character can stand in JSON's escapes, but not in the answer.
    return given[:200].encode("utf-8", "replace").decode() if isinstance(given, str) else None
