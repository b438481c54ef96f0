"""Many frames in one request: which errors are one frame's own, and which end the whole request."""

from __future__ import annotations

import logging

from starlette.requests import Request

from core import errors
from service.faults import Fault, FrameNeeded, InvalidRequest, UnsupportedMediaType
from service.problems import Problem, request_problem

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
    if not isinstance(error, OWN_ERRORS):
        if isinstance(error, (Fault, errors.PlacerecError)):
            raise error
        log.error("a frame of a batch failed", exc_info=error, extra={"request_id": request.state.request_id})
    return request_problem(request, error)
