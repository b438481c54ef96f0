"""Problems of RFC 9457: one table gives the status, the stable type and the title of every error class."""

from __future__ import annotations

import asyncio
import errno
import http
import logging
import random
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any
from urllib.parse import quote

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response

from core import errors
from core.disk.files import disk_errors
from service.errors import faults
from service.fairness import CALLER, RefusalPace

MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:placerec:problem:"
RETRY_AFTER_SECONDS = (1, 3)
"""The range of Retry-After, at random so that clients that were refused together do not return together."""

RETRY_LATE_SECONDS = (5, 15)
"""The same where the wait is longer: for a job, the end of a session, a restart."""

PATH_CHARACTERS = "/:@!$&'()*+,;="

SHORTAGES = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS})
"""Errors of the system that are no mistake of the request and may pass."""

log = logging.getLogger("placerec.problems")


class Problem(BaseModel):
    """A problem, for a program (``type``, ``status``) and for a person (``title``, ``detail``)."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(description="The stable name of this kind of problem.")
    title: str = Field(description="The kind of problem in a few words; always the same for a type.")
    status: int = Field(description="The HTTP status.")
    detail: str = Field(description="The fault of this request, and the remedy.")
    instance: str | None = Field(default=None, description="The path of the request.")
    request_id: str | None = Field(default=None, description="The id of the request, which is also in the log.")


@dataclass(frozen=True)
class Kind:
    """A kind of problem: its HTTP status, the last part of its type, and its title."""

    status: int
    slug: str
    title: str

    @property
    def type(self) -> str:
        """The problem's stable ``type``."""
        return TYPE_PREFIX + self.slug


INTERNAL = Kind(500, "internal-error", "The service failed")
INVALID_REQUEST = Kind(422, "invalid-request", "The request is not valid")
MALFORMED_BODY = Kind(400, "malformed-body", "The body cannot be parsed")

KINDS: dict[type[Exception], Kind] = {
    # Images
    errors.InvalidImage: Kind(422, "invalid-image", "The frame cannot be used"),
    errors.EmptyImage: Kind(422, "empty-image", "The frame is empty"),
    errors.NotAnImage: Kind(422, "not-an-image", "The frame is not an image"),
    errors.UnsupportedFormat: Kind(415, "unsupported-format", "The image is not a JPEG, PNG or WebP file"),
    errors.TruncatedImage: Kind(422, "truncated-image", "The image is cut short"),
    errors.ImageTooLarge: Kind(413, "image-too-large", "The frame has too many bytes"),
    errors.TooManyPixels: Kind(413, "too-many-pixels", "The frame has too many pixels"),
    errors.ImageTooSmall: Kind(422, "image-too-small", "The image is smaller than 16 pixels on one side"),
    errors.NoRegions: Kind(422, "no-regions", "The frame has no region of interest"),
    errors.UnfitIntrinsics: Kind(422, "unfit-intrinsics", "The camera's intrinsics do not fit the frame"),
    # Models
    errors.InvalidKeypoints: Kind(500, "invalid-keypoints", "Keypoints of a place are damaged"),
    errors.InvalidModel: Kind(503, "invalid-model", "A model cannot be used"),
    errors.MissingWeights: Kind(503, "missing-weights", "A model has no weights"),
    errors.WrongVocabulary: Kind(503, "wrong-vocabulary", "The vocabulary was trained for another network"),
    errors.GoldenMismatch: Kind(503, "golden-mismatch", "The encoder does not reproduce its golden values"),
    errors.UnknownEncoder: Kind(422, "unknown-encoder", "The encoder is not installed"),
    errors.WrongEncoder: Kind(409, "wrong-encoder", "The map belongs to another encoder"),
    faults.EncoderNotInstalled: Kind(503, "encoder-not-installed", "The encoder of the map is not installed"),
    # Maps and places
    errors.InvalidIdentifier: Kind(422, "invalid-identifier", "The id is not valid"),
    errors.InvalidField: Kind(422, "invalid-field", "A field is not valid"),
    errors.MixedCoordinates: Kind(409, "mixed-coordinates", "The map has coordinates of the other kind"),
    errors.InvalidCursor: Kind(422, "invalid-cursor", "The cursor does not belong to this list"),
    errors.UnknownMap: Kind(404, "unknown-map", "The map does not exist"),
    errors.MapExists: Kind(409, "map-exists", "A map of this id already exists"),
    errors.UnknownPlace: Kind(404, "unknown-place", "The place does not exist"),
    errors.UnknownLook: Kind(404, "unknown-look", "The place has no such look"),
    errors.RepeatedLook: Kind(409, "repeated-look", "The look is the place's own frame"),
    errors.LookNameTaken: Kind(409, "look-name-taken", "Another frame of the place has the name of this look"),
    errors.TooManyLooks: Kind(409, "too-many-looks", "The place has as many looks as it may have"),
    errors.TooManyToDelete: Kind(422, "too-many-to-delete", "Too many places would be deleted at once"),
    errors.UnknownSequence: Kind(404, "unknown-sequence", "The sequence does not exist"),
    errors.UnknownFrame: Kind(404, "unknown-frame", "The frame is not stored for review"),
    errors.UnknownStretch: Kind(404, "unknown-stretch", "No such stretch waits for review"),
    errors.UnknownCamera: Kind(404, "unknown-camera", "The camera does not exist"),
    faults.NotLocalized: Kind(404, "not-localized", "The frame was not recognized"),
    faults.NoGeoPose: Kind(406, "no-geopose", "The answer has no GeoPose"),
    faults.PlanTooLarge: Kind(422, "plan-too-large", "The plan would list too many places"),
    faults.PlaceTaken: Kind(409, "place-taken", "The place has another frame"),
    errors.NoThumbnail: Kind(404, "no-thumbnail", "The map keeps no picture of the place"),
    errors.CalibrationImpossible: Kind(422, "calibration-impossible", "The map cannot be calibrated with these frames"),
    errors.CalibrationWorse: Kind(409, "calibration-worse", "The calibration would make answers worse"),
    errors.RevisionMismatch: Kind(412, "revision-mismatch", "The map has changed"),
    # Jobs and upkeep
    faults.ImagesMissing: Kind(409, "images-missing", "The map does not keep all its images"),
    faults.MergeConflict: Kind(409, "merge-conflict", "The maps cannot be merged as they are"),
    faults.NothingToMeasure: Kind(422, "nothing-to-measure", "The map has no frames to measure the recall with"),
    faults.TooManyPairs: Kind(422, "too-many-pairs", "The traverses have too many frames to be compared"),
    faults.TooFewFrames: Kind(422, "too-few-frames", "The sequence is too short to be aligned"),
    faults.BackupFolderMissing: Kind(409, "backup-folder-missing", "There is no folder for backups"),
    faults.BackupIncomplete: Kind(503, "backup-incomplete", "Some maps could not be saved"),
    faults.UnknownRecording: Kind(404, "unknown-recording", "Nothing of the recording is here"),
    faults.RecordingOffset: Kind(409, "recording-offset", "The piece does not continue the recording"),
    faults.RecordingInUse: Kind(409, "recording-in-use", "A job reads the recording"),
    faults.UnknownJob: Kind(404, "unknown-job", "The job does not exist"),
    faults.JobEnded: Kind(409, "job-ended", "The job has already ended"),
    faults.JobLost: Kind(503, "job-lost", "The service stopped before the job ended"),
    # Sessions
    faults.UnknownSession: Kind(404, "unknown-session", "The session does not exist"),
    faults.SessionExpired: Kind(410, "session-expired", "The session has ended"),
    faults.TooManySessions: Kind(429, "too-many-sessions", "Too many sessions are open"),
    errors.FrameOutOfOrder: Kind(409, "frame-out-of-order", "The frame is older than an earlier one of the session"),
    faults.SessionOfAnother: Kind(403, "session-of-another", "The session belongs to another key"),
    faults.StreamTaken: Kind(409, "stream-taken", "Another connection streams into the session"),
    # Storage
    errors.StorageFull: Kind(507, "storage-full", "The disk is full"),
    errors.StorageFailure: Kind(500, "storage-failure", "The disk failed"),
    errors.TooManyOpenFiles: Kind(503, "too-many-open-files", "Too many files are open"),
    errors.StoreUnavailable: Kind(503, "store-unavailable", "The maps cannot be reached"),
    errors.StoreOfAnotherVersion: Kind(503, "store-of-another-version", "The maps were stored by another version"),
    errors.MapBusy: Kind(503, "map-busy", "What is to be erased is still being read"),
    errors.MapQuarantined: Kind(503, "map-quarantined", "The map is damaged and out of service"),
    errors.DataDirectoryLocked: Kind(503, "data-directory-locked", "Another process uses the data directory"),
    errors.DataDirectoryTooNew: Kind(503, "data-directory-too-new", "The data was written by a later version"),
    errors.DataDirectoryTooOld: Kind(503, "data-directory-too-old", "The data was written by an earlier version"),
    # Maps as files
    errors.InvalidArchive: Kind(422, "invalid-archive", "The file is not a valid export of a map"),
    errors.ArchiveTooNew: Kind(422, "archive-too-new", "The file was written by a later version"),
    faults.DigestMismatch: Kind(422, "digest-mismatch", "The body does not match its digest"),
    faults.ExportGone: Kind(412, "export-gone", "The export is no longer stored"),
    faults.RangeNotSatisfiable: Kind(416, "range-not-satisfiable", "The range begins after the end"),
    faults.TooManyExports: Kind(503, "too-many-exports", "Too many maps are being exported"),
    faults.TooManyImports: Kind(503, "too-many-imports", "Too many maps are being imported"),
    # Traverses on disk, which only the command line reads
    errors.InvalidRecording: Kind(422, "invalid-recording", "The recording cannot be used"),
    errors.UnknownTopic: Kind(404, "unknown-topic", "The bag has no such topic"),
    errors.InvalidTrajectory: Kind(422, "invalid-trajectory", "The trajectory cannot be used"),
    errors.MissingExtra: Kind(503, "missing-extra", "A package is not installed"),
    errors.InvalidTraverse: Kind(422, "invalid-traverse", "The directory is not a traverse"),
    errors.InvalidGroundTruth: Kind(422, "invalid-ground-truth", "The ground truth cannot be used"),
    errors.InvalidResults: Kind(422, "invalid-results", "The results cannot be used"),
    # The content of the request
    faults.MalformedBody: MALFORMED_BODY,
    faults.InvalidRequest: INVALID_REQUEST,
    faults.ImplausiblePose: Kind(422, "implausible-pose", "No vehicle can have been at the pose"),
    faults.UnsupportedMediaType: Kind(415, "unsupported-media-type", "The content type is not supported here"),
    faults.BodyTooLarge: Kind(413, "body-too-large", "The body has too many bytes"),
    faults.FrameNeeded: Kind(409, "frame-needed", "The frame has to be sent"),
    faults.NothingEnrolled: Kind(422, "nothing-enrolled", "No frame became a place"),
    faults.PlacesTaken: Kind(409, "places-taken", "Places of other frames have these ids"),
    faults.BatchOutOfOrder: Kind(409, "batch-out-of-order", "The batch before it is not stored"),
    faults.UnknownExplanation: Kind(404, "unknown-explanation", "The picture does not exist or is no longer stored"),
    # Load
    faults.QueueFull: Kind(503, "queue-full", "Too many requests are waiting"),
    faults.MemoryFull: Kind(503, "memory-full", "Too many uploads are under way"),
    faults.DeadlineExceeded: Kind(503, "deadline-exceeded", "The time of the request is up"),
    faults.StagingFull: Kind(503, "staging-full", "Too many frames are waiting to be enrolled"),
    faults.JobQueueFull: Kind(503, "job-queue-full", "Too many jobs are waiting"),
    faults.TooManyWatchers: Kind(503, "too-many-watchers", "Too many clients follow jobs"),
    faults.TooManyListeners: Kind(503, "too-many-listeners", "Too many clients listen to events"),
    faults.NotReady: Kind(503, "not-ready", "The service is not ready"),
    faults.Stopping: Kind(503, "stopping", "The service is stopping"),
    faults.TooManyConnections: Kind(503, "too-many-connections", "Too many connections are open"),
    # The connection
    faults.MalformedHead: Kind(400, "malformed-head", "The request is not valid HTTP"),
    faults.HeadTooSlow: Kind(408, "head-too-slow", "The request did not arrive in time"),
    faults.UrlTooLong: Kind(414, "url-too-long", "The path and the query string are too long"),
    faults.HeadTooLarge: Kind(431, "head-too-large", "The headers are too many or too long"),
    faults.UnknownTransferCoding: Kind(501, "unknown-transfer-coding", "The transfer coding is not known"),
    # Limits of the installation
    faults.TooManyMaps: Kind(409, "too-many-maps", "No more maps can be created"),
    faults.TooManyPlaces: Kind(409, "too-many-places", "The map can hold no more places"),
    faults.ClientGone: Kind(499, "client-gone", "The client closed the connection"),
    # Access
    faults.KeyNeeded: Kind(401, "key-needed", "A key is needed"),
    faults.KeyRefused: Kind(401, "key-refused", "The key is not valid"),
    faults.RoleTooLow: Kind(403, "role-too-low", "The key's role does not allow this"),
    faults.MapForbidden: Kind(403, "map-forbidden", "The key is limited to other maps"),
    faults.ForeignPage: Kind(403, "foreign-page", "Requests from other web sites are refused"),
    faults.RateExceeded: Kind(429, "rate-exceeded", "Too many requests a second"),
    faults.UnknownKey: Kind(404, "unknown-key", "The key does not exist"),
    faults.KeyExists: Kind(409, "key-exists", "Another key has this name"),
    faults.FirstKeyLocal: Kind(403, "first-key-local", "The first key is created on the service's own machine"),
    faults.KeyEnded: Kind(409, "key-ended", "The key is revoked or has expired"),
    faults.KeyWidened: Kind(409, "key-widened", "A key can only be narrowed"),
    faults.LastAdminKey: Kind(409, "last-admin-key", "No key could manage the service any more"),
    faults.TooManyKeys: Kind(409, "too-many-keys", "No more keys can be created"),
    faults.KeysUnreadable: Kind(503, "keys-unreadable", "The keys cannot be read"),
}

BY_STATUS: dict[int, Kind] = {
    400: Kind(400, "bad-request", "The request cannot be understood"),
    404: Kind(404, "unknown-path", "There is no such resource"),
    405: Kind(405, "method-not-allowed", "The resource does not support this method"),
    500: INTERNAL,
}
"""Kinds of the problems that the framework raises, by status."""

RETRY_LATER = (
    faults.QueueFull,
    faults.MemoryFull,
    faults.DeadlineExceeded,
    faults.NotReady,
    errors.TooManyOpenFiles,
    errors.StoreUnavailable,
    faults.KeysUnreadable,
    faults.JobQueueFull,
    faults.StagingFull,
    faults.TooManyExports,
    faults.TooManyImports,
    faults.TooManyWatchers,
    faults.TooManyListeners,
    faults.TooManySessions,
    faults.TooManyConnections,
    faults.Stopping,
)
"""Problems that pass: their answers have Retry-After."""

RETRY_LATE = (
    faults.TooManyExports,
    faults.TooManyImports,
    faults.JobQueueFull,
    faults.TooManyWatchers,
    faults.TooManyListeners,
    faults.TooManySessions,
    faults.Stopping,
)
"""Those of them that take longer to pass."""


def retry_after(error: Exception) -> str:
    """The value of Retry-After: seconds until the request is worth sending again."""
    return str(random.randint(*RETRY_LATE_SECONDS if isinstance(error, RETRY_LATE) else RETRY_AFTER_SECONDS))


def kind_of(error: Exception) -> Kind:
    """The kind of an exception: that of its nearest base class in the table."""
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
    """An unexpected error of the system (memory, files, disk) as the error class for it; other errors as they are."""
    if isinstance(error, MemoryError):
        return faults.MemoryFull("There is not enough memory for this request now. Try again later.")
    if isinstance(error, OSError) and error.errno in SHORTAGES:
        try:
            with disk_errors("do what was requested"):
                raise error
        except errors.PlacerecError as refusal:
            return refusal
    return error


def told(error: Exception, confided: bool) -> str:
    """The text of an error, for those who may know the addresses of an installation or for those who may not."""
    public: str | None = getattr(error, "public", None)
    return str(error) if confided or public is None else public


def problem_of(
    error: Exception, instance: str | None = None, request_id: str | None = None, confided: bool = True
) -> Problem:
    """The problem object of an exception; that of an unexpected exception says only that it happened.

    Args:
        confided: whether its reader may know addresses, paths and peers of the installation.
    """
    error = declared(error)
    kind = kind_of(error)
    detail = told(error, confided) or kind.title
    if kind is INTERNAL:
        detail = "An unexpected error occurred; it is in the log under the request id."
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
    """A list of Pydantic's errors as one fault, without the rejected values."""
    listed = []
    for fault in found:
        location = ".".join(str(part) for part in fault["loc"])
        listed.append({"location": location, "message": str(fault["msg"]).removeprefix("Value error, ")})
    first = listed[0] if listed else {"location": "", "message": "it is not valid"}
    where = f"{first['location']}: " if first["location"] else ""
    more = f" ({len(listed) - 1} more)" if len(listed) > 1 else ""
    return faults.InvalidRequest(f"{where}{first['message']}{more}", listed)


def request_problem(request: Request, error: Exception) -> Problem:
    """The problem object of an exception that a request raised."""
    # Not request.url, which fails for a malformed Host header.
    path, request_id = quote(request.scope["path"], safe=PATH_CHARACTERS), getattr(request.state, "request_id", None)
    return problem_of(error, path, request_id, is_confided(request.state))


def is_confided(state: Any) -> bool:
    """Whether the caller of a request, by its state, may know addresses; not before it is known who it is."""
    return getattr(getattr(state, "principal", None), "confided", False)


def problem_response(request: Request, error: Exception) -> Response:
    """The answer to a request that raised ``error``; its kind is noted for the log and the metrics."""
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


async def _answer(pace: RefusalPace, request: Request, error: Exception) -> Response:
    if isinstance(error, RequestValidationError):
        error = invalid_request(error.errors())
    elif isinstance(error, HTTPException) and isinstance(error.__cause__, faults.Fault):
        error = error.__cause__  # the framework raised a plain 400 from it while it read the body
    busy = isinstance(error, RETRY_LATER) and not isinstance(error, faults.Stopping)
    if busy and (pause := pace.pause(CALLER.get())):
        await asyncio.sleep(pause)
    return problem_response(request, error)


def install_problems(app: FastAPI, pace: RefusalPace) -> None:
    """Answer every error class of the table, and the framework's own errors, with its problem object.

    Args:
        pace: at which callers are told to come again.
    """
    for cls in (errors.PlacerecError, faults.Fault, HTTPException, RequestValidationError):
        app.add_exception_handler(cls, partial(_answer, pace))


def problem_documentation(*kinds: type[Exception]) -> dict[int | str, dict[str, Any]]:
    """OpenAPI ``responses`` that list, by status, the problems that a route can answer with.

    Those that all operations share are added by ``service.http.openapi``: a route names only its own.
    """
    documented: dict[int | str, dict[str, Any]] = {}
    document_problems(documented, kinds)
    return documented


def document_problems(documented: dict[Any, dict[str, Any]], kinds: Iterable[type[Exception]], key: type = int) -> None:
    """Add problems to OpenAPI ``responses``; ``key`` is the type of the statuses that are their keys."""
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
