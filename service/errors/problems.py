"""RFC 9457 problems: one table from error classes to status, stable type and title, for every path."""

from __future__ import annotations

import errno
import http
import logging
import random
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response

from core import errors
from core.storage.files.disk import refusals
from service.errors import faults

MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:placerec:problem:"
RETRY_AFTER_SECONDS = (1, 3)
"""Least and most: one at random, so that those who were refused together do not come again together."""

RETRY_LATE_SECONDS = (5, 15)
"""The same where what is waited for takes its time: a job, a session's end, a restart."""

PATH_CHARACTERS = "/:@!$&'()*+,;="

SHORTAGES = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS})
"""What a file can be refused for that is nobody's mistake and may pass."""

log = logging.getLogger("placerec.problems")


class Problem(BaseModel):
    """What went wrong, for a machine (``type``, ``status``) and for a person (``title``, ``detail``)."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(description="Stable name of the kind of problem.")
    title: str = Field(description="The kind of problem in a few words, always the same for a type.")
    status: int = Field(description="The HTTP status.")
    detail: str = Field(description="What is wrong with this request.")
    instance: str | None = Field(default=None, description="Path of the request.")
    request_id: str | None = Field(default=None, description="The request's id, which stands in the log too.")


@dataclass(frozen=True)
class Kind:
    """One kind of problem."""

    status: int
    slug: str
    title: str

    @property
    def type(self) -> str:
        """The problem's stable ``type``."""
        return TYPE_PREFIX + self.slug


INTERNAL = Kind(500, "internal-error", "The service failed")
INVALID_REQUEST = Kind(422, "invalid-request", "The request does not fit the contract")
MALFORMED_BODY = Kind(400, "malformed-body", "The body cannot be parsed")

KINDS: dict[type[Exception], Kind] = {
    # Images
    errors.InvalidImage: Kind(422, "invalid-image", "The frame cannot be used"),
    errors.EmptyImage: Kind(422, "empty-image", "The frame has no bytes"),
    errors.NotAnImage: Kind(422, "not-an-image", "The bytes are not an image"),
    errors.UnsupportedFormat: Kind(415, "unsupported-format", "Not JPEG, PNG or WebP"),
    errors.TruncatedImage: Kind(422, "truncated-image", "The image is cut short"),
    errors.ImageTooLarge: Kind(413, "image-too-large", "The frame has too many bytes"),
    errors.TooManyPixels: Kind(413, "too-many-pixels", "The frame has too many pixels"),
    errors.ImageTooSmall: Kind(422, "image-too-small", "A side is under 16 pixels"),
    errors.NoRegions: Kind(422, "no-regions", "The frame shows nothing to remember"),
    # Models
    errors.InvalidModel: Kind(503, "invalid-model", "A model cannot be used"),
    errors.MissingWeights: Kind(503, "missing-weights", "A model lacks its weights"),
    errors.WrongVocabulary: Kind(503, "wrong-vocabulary", "A vocabulary belongs to another network"),
    errors.GoldenMismatch: Kind(503, "golden-mismatch", "The encoder does not reproduce its golden values"),
    errors.UnknownEncoder: Kind(422, "unknown-encoder", "No such encoder is installed"),
    errors.WrongEncoder: Kind(409, "wrong-encoder", "The map is bound to another encoder"),
    faults.EncoderNotInstalled: Kind(503, "encoder-not-installed", "The map's encoder is not installed"),
    # Maps and places
    errors.InvalidIdentifier: Kind(422, "invalid-identifier", "Not a valid id"),
    errors.InvalidField: Kind(422, "invalid-field", "A field is malformed"),
    errors.InvalidCursor: Kind(422, "invalid-cursor", "The cursor is not of this listing"),
    errors.UnknownMap: Kind(404, "unknown-map", "No such map"),
    errors.MapExists: Kind(409, "map-exists", "The map exists already"),
    errors.UnknownPlace: Kind(404, "unknown-place", "No such place"),
    errors.UnknownSequence: Kind(404, "unknown-sequence", "No such sequence"),
    errors.UnknownCamera: Kind(404, "unknown-camera", "No such camera"),
    faults.PlaceTaken: Kind(409, "place-taken", "The place has another frame"),
    errors.NoThumbnail: Kind(404, "no-thumbnail", "No picture is kept of the place"),
    errors.CalibrationImpossible: Kind(422, "calibration-impossible", "The map cannot be calibrated so"),
    errors.RevisionMismatch: Kind(412, "revision-mismatch", "The map was changed in between"),
    # Jobs and upkeep
    faults.ImagesMissing: Kind(409, "images-missing", "The map lacks images"),
    faults.MergeConflict: Kind(409, "merge-conflict", "The maps cannot be merged as they are"),
    faults.NothingToMeasure: Kind(422, "nothing-to-measure", "There is nothing to measure the recall by"),
    faults.UnknownJob: Kind(404, "unknown-job", "No such job"),
    faults.JobEnded: Kind(409, "job-ended", "The job has ended already"),
    faults.JobLost: Kind(503, "job-lost", "The service ended before the job did"),
    # Sessions
    faults.UnknownSession: Kind(404, "unknown-session", "No such session"),
    faults.SessionExpired: Kind(410, "session-expired", "The session is over"),
    faults.TooManySessions: Kind(429, "too-many-sessions", "Too many sessions"),
    faults.FrameOutOfOrder: Kind(409, "frame-out-of-order", "The frame comes too late"),
    faults.StreamTaken: Kind(409, "stream-taken", "Another connection streams into the session"),
    # Storage
    errors.StorageFull: Kind(507, "storage-full", "The disk is full"),
    errors.StorageFailure: Kind(500, "storage-failure", "The disk failed"),
    errors.MapQuarantined: Kind(503, "map-quarantined", "The map is damaged and out of service"),
    errors.DataDirectoryLocked: Kind(503, "data-directory-locked", "Another process holds the data"),
    errors.DataDirectoryTooNew: Kind(503, "data-directory-too-new", "The data is of a later version"),
    # Maps as files
    errors.InvalidArchive: Kind(422, "invalid-archive", "The file is not the export of a map, or is damaged"),
    errors.ArchiveTooNew: Kind(422, "archive-too-new", "The file is of a later version"),
    faults.DigestMismatch: Kind(422, "digest-mismatch", "The body is not the one that was to come"),
    faults.ExportGone: Kind(412, "export-gone", "The rest of the download is not there any more"),
    faults.RangeNotSatisfiable: Kind(416, "range-not-satisfiable", "The range begins behind the end"),
    faults.TooManyExports: Kind(503, "too-many-exports", "Too many maps are being exported"),
    faults.TooManyImports: Kind(503, "too-many-imports", "Too many maps are being imported"),
    # Traverses on disk: the command line's own, which no request reaches
    errors.InvalidTraverse: Kind(422, "invalid-traverse", "The directory is no traverse"),
    errors.InvalidGroundTruth: Kind(422, "invalid-ground-truth", "The ground truth cannot be used"),
    errors.InvalidResults: Kind(422, "invalid-results", "The results cannot be used"),
    # The request itself
    faults.MalformedBody: MALFORMED_BODY,
    faults.InvalidRequest: INVALID_REQUEST,
    faults.UnsupportedMediaType: Kind(415, "unsupported-media-type", "The content type is not taken here"),
    faults.BodyTooLarge: Kind(413, "body-too-large", "The body has too many bytes"),
    faults.FrameNeeded: Kind(409, "frame-needed", "The place does not hold this frame"),
    faults.BatchOutOfOrder: Kind(409, "batch-out-of-order", "The batch before it is not stored"),
    faults.UnknownExplanation: Kind(404, "unknown-explanation", "No such picture, or not any more"),
    # The moment
    faults.QueueFull: Kind(503, "queue-full", "Too many requests wait"),
    faults.MemoryFull: Kind(503, "memory-full", "Too many uploads at one time"),
    faults.DeadlineExceeded: Kind(503, "deadline-exceeded", "The time was up"),
    faults.StagingFull: Kind(503, "staging-full", "Too much waits to be enrolled"),
    faults.JobQueueFull: Kind(503, "job-queue-full", "Too many jobs wait"),
    faults.TooManyWatchers: Kind(503, "too-many-watchers", "Too many follow jobs"),
    faults.NotReady: Kind(503, "not-ready", "The service is not ready"),
    faults.Stopping: Kind(503, "stopping", "The service is stopping"),
    faults.TooManyConnections: Kind(503, "too-many-connections", "Too many connections"),
    # The connection
    faults.MalformedHead: Kind(400, "malformed-head", "Not a request of HTTP"),
    faults.HeadTooSlow: Kind(408, "head-too-slow", "The request did not come in time"),
    faults.UrlTooLong: Kind(414, "url-too-long", "The path and query string are too long"),
    faults.HeadTooLarge: Kind(431, "head-too-large", "Too many headers, or too long ones"),
    # What the installation holds
    faults.TooManyMaps: Kind(409, "too-many-maps", "There are as many maps as there may be"),
    faults.TooManyPlaces: Kind(409, "too-many-places", "The map holds as many places as it may"),
    faults.ClientGone: Kind(499, "client-gone", "The caller hung up"),
    # Who asks
    faults.KeyNeeded: Kind(401, "key-needed", "A key is needed"),
    faults.KeyRefused: Kind(401, "key-refused", "The key is not valid"),
    faults.RoleTooLow: Kind(403, "role-too-low", "The key's role does not allow this"),
    faults.MapForbidden: Kind(403, "map-forbidden", "The key is limited to other maps"),
    faults.ForeignPage: Kind(403, "foreign-page", "Not from a page or a name of elsewhere"),
    faults.RateExceeded: Kind(429, "rate-exceeded", "Too many requests a second"),
    faults.KeysUnreadable: Kind(503, "keys-unreadable", "The keys cannot be read"),
}

BY_STATUS: dict[int, Kind] = {
    400: Kind(400, "bad-request", "The request cannot be understood"),
    404: Kind(404, "unknown-path", "No such resource"),
    405: Kind(405, "method-not-allowed", "The resource has no such method"),
    500: INTERNAL,
}
"""Kinds of the problems that the framework finds by itself."""

RETRY_LATER = (
    faults.QueueFull,
    faults.MemoryFull,
    faults.DeadlineExceeded,
    faults.NotReady,
    faults.JobQueueFull,
    faults.StagingFull,
    faults.TooManyExports,
    faults.TooManyImports,
    faults.TooManyWatchers,
    faults.TooManySessions,
    faults.TooManyConnections,
    faults.Stopping,
)

RETRY_LATE = (
    faults.TooManyExports,
    faults.TooManyImports,
    faults.JobQueueFull,
    faults.TooManyWatchers,
    faults.TooManySessions,
    faults.Stopping,
)


def retry_after(error: Exception) -> str:
    """Seconds after which a request that was refused for the moment is worth sending again."""
    return str(random.randint(*RETRY_LATE_SECONDS if isinstance(error, RETRY_LATE) else RETRY_AFTER_SECONDS))


def kind_of(error: Exception) -> Kind:
    """The kind of problem that an exception is: that of its nearest class in the table."""
    for cls in type(error).__mro__:
        if cls in KINDS:
            return KINDS[cls]
    if isinstance(error, HTTPException):
        status = error.status_code
        if status in BY_STATUS:
            return BY_STATUS[status]
        phrase = http.HTTPStatus(status).phrase
        return Kind(status, phrase.lower().replace(" ", "-"), phrase)
    return INTERNAL


def declared(error: Exception) -> Exception:
    """What the system refused where nobody had reckoned with it, as what it is elsewhere; else the error itself."""
    if isinstance(error, MemoryError):
        return faults.MemoryFull("The memory does not suffice for this request at the moment.")
    if isinstance(error, OSError) and error.errno in SHORTAGES:
        try:
            with refusals("do what was asked for"):
                raise error
        except errors.PlacerecError as refusal:
            return refusal
    return error


def problem_of(error: Exception, instance: str | None = None, request_id: str | None = None) -> Problem:
    """The problem that an exception is; nothing of an unexpected one is told but that it happened."""
    error = declared(error)
    kind = kind_of(error)
    detail = str(error) or kind.title
    if kind is INTERNAL:
        detail = "An unexpected error was logged under the request id."
    if isinstance(error, HTTPException):
        detail = str(error.detail)
    extras: dict[str, Any] = {}
    if isinstance(error, faults.InvalidRequest) and error.errors:
        extras["errors"] = error.errors
    if isinstance(error, faults.NotReady):
        extras["checks"] = error.checks
    return Problem(
        type=kind.type,
        title=kind.title,
        status=kind.status,
        detail=detail,
        instance=instance,
        request_id=request_id,
        **extras,
    )


def invalid_request(found: Iterable[Mapping[str, Any]]) -> faults.InvalidRequest:
    """Pydantic's list of errors as one fault; the rejected values are not repeated."""
    listed = []
    for fault in found:
        location = ".".join(str(part) for part in fault["loc"])
        listed.append({"location": location, "message": str(fault["msg"]).removeprefix("Value error, ")})
    first = listed[0] if listed else {"location": "", "message": "it is malformed"}
    where = f"{first['location']}: " if first["location"] else ""
    more = f" ({len(listed) - 1} more)" if len(listed) > 1 else ""
    return faults.InvalidRequest(f"{where}{first['message']}{more}", listed)


def request_problem(request: Request, error: Exception) -> Problem:
    """The problem that an exception is for a request."""
    # Not request.url: a broken Host header would break that, too.
    return problem_of(
        error, quote(request.scope["path"], safe=PATH_CHARACTERS), getattr(request.state, "request_id", None)
    )


def problem_response(request: Request, error: Exception) -> Response:
    """The answer to a request that ended in ``error``; its kind is noted for the log and the counters."""
    error = declared(error)
    problem = request_problem(request, error)
    request.state.problem = problem.type.removeprefix(TYPE_PREFIX)
    headers: dict[str, str] = {}
    headers.update(getattr(error, "headers", None) or {})
    if isinstance(error, RETRY_LATER):
        headers["Retry-After"] = retry_after(error)
    elif problem.status >= 500:
        trace = error if problem.status == 500 else None
        log.error("%s: %s", problem.type, error, exc_info=trace, extra={"request_id": problem.request_id})
    body = problem.model_dump(exclude_none=True)
    return JSONResponse(body, problem.status, headers, media_type=MEDIA_TYPE)


async def _answer(request: Request, error: Exception) -> Response:
    if isinstance(error, RequestValidationError):
        error = invalid_request(error.errors())
    elif isinstance(error, HTTPException) and isinstance(error.__cause__, faults.Fault):
        error = error.__cause__  # raised while the framework read the body, which hides it behind a plain 400
    return problem_response(request, error)


def install_problems(app: FastAPI) -> None:
    """Answer each class of the table, and what the framework raises, with its problem."""
    for cls in (errors.PlacerecError, faults.Fault, HTTPException, RequestValidationError):
        app.add_exception_handler(cls, _answer)


def problem_documentation(*kinds: type[Exception]) -> dict[int | str, dict[str, Any]]:
    """OpenAPI ``responses`` that name, under each status, the problems that a route can answer with.

    Those that all operations share are added by ``service.http.openapi``: a route names only its own.
    """
    documented: dict[int | str, dict[str, Any]] = {}
    document_problems(documented, kinds)
    return documented


def document_problems(documented: dict[Any, dict[str, Any]], kinds: Iterable[type[Exception]], key: type = int) -> None:
    """Add problems to OpenAPI ``responses``, beside those that stand there; ``key`` is the type of their statuses."""
    for cls in kinds:
        kind = KINDS[cls]
        entry = documented.setdefault(key(kind.status), {"description": ""})
        content = entry.setdefault("content", {}).setdefault(MEDIA_TYPE, {})
        examples = content.setdefault("examples", {})
        if kind.slug not in examples:
            entry["description"] = "; ".join(filter(None, [entry["description"], kind.title]))
            examples[kind.slug] = {"$ref": f"#/components/examples/{kind.slug}"}
        content["schema"] = {"$ref": "#/components/schemas/Problem"}


def problem_examples() -> dict[str, Any]:
    """One example of each kind of problem, for the OpenAPI document."""
    return {
        kind.slug: {
            "value": {"type": kind.type, "title": kind.title, "status": kind.status, "detail": f"{kind.title}."}
        }
        for kind in KINDS.values()
    }
