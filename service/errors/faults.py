"""The errors of the service, besides those of the core; one class each.

``service.errors.problems`` maps them, like the errors of the core, to status codes and problem types.
"""

from __future__ import annotations

import math
from typing import ClassVar


class Fault(Exception):
    """Base of all classes below; its text explains to the caller, in a sentence, the fault and the remedy.

    public: as that of :class:`core.errors.PlacerecError`.
    """

    public: str | None = None


class MalformedBody(Fault):
    """The body cannot be parsed: broken JSON, broken multipart."""


class InvalidRequest(Fault):
    """Parameters, headers or the contents of the body are not valid.

    Args:
        detail: a sentence.
        errors: ``{"location": …, "message": …}`` for each error.
    """

    def __init__(self, detail: str, errors: list[dict[str, str]] | None = None) -> None:
        super().__init__(detail)
        self.errors = errors or []


class ImplausiblePose(Fault):
    """No vehicle can have come from the poses beside it to this one, or it is what a receiver writes without a fix."""


class UnsupportedMediaType(Fault):
    """The resource does not support the content type or coding, or the bytes are of another type.

    Args:
        headers: of the answer.
    """

    def __init__(self, detail: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(detail)
        self.headers = headers


class BodyTooLarge(Fault):
    """The body has more bytes than the limit of the resource; the rest was not read."""


class QueueFull(Fault):
    """Too many requests wait for the encoder."""


class MemoryFull(Fault):
    """The uploads under way leave no memory for this one."""


class DeadlineExceeded(Fault):
    """The time of the request was up before its frame was encoded; nothing was done."""


class ClientGone(Fault):
    """The client closed the connection before its turn came; nobody reads the answer."""


class NotReady(Fault):
    """A readiness check fails.

    Args:
        checks: the result of each check, "ok" or what is wrong.
    """

    def __init__(self, detail: str, checks: dict[str, str]) -> None:
        super().__init__(detail)
        self.checks = checks


class EncoderNotInstalled(Fault):
    """The encoder of the map is not installed."""


class FrameNeeded(Fault):
    """The frame was named by its digest, but the place has another frame or does not exist."""


class NothingEnrolled(InvalidRequest):
    """None of the frames of a job became a place; ``errors`` has the first of them, each with its reason."""


class PlacesTaken(Fault):
    """Places of other frames have the ids of these, and nobody said that they are to be replaced."""


class BatchOutOfOrder(Fault):
    """The batch was to be stored after another one, which is not stored; nothing of it was stored."""


class UnknownExplanation(Fault):
    """The picture of an explanation does not exist, or is no longer stored."""


class PlaceTaken(Fault):
    """A place with this id has another frame, which is not to be replaced."""


class UnknownJob(Fault):
    """The job does not exist, or ended so long ago that it is no longer stored."""


class JobEnded(Fault):
    """The job has ended, so it cannot be cancelled."""


class JobQueueFull(Fault):
    """Too many jobs wait."""


class BackupFolderMissing(Fault):
    """No setting names a folder for backups."""


class BackupIncomplete(Fault):
    """A backup was made that lacks the present state of some maps."""


class UnknownRecording(Fault):
    """Nothing of a recording of this name is here."""


class RecordingOffset(Fault):
    """A piece of a recording does not begin where the bytes that are here end, or another piece is arriving."""


class RecordingInUse(Fault):
    """A job reads the recording."""


class StagingFull(Fault):
    """The frames that wait on disk to be enrolled leave no room for more."""


class JobLost(Fault):
    """The service stopped before the job ended, and a job of this kind cannot be resumed."""


class ImagesMissing(Fault):
    """The map does not keep the image of every place, so it cannot be re-encoded."""


class MergeConflict(Fault):
    """The maps cannot be merged: places, sequences or cameras of the same name differ."""


class NothingToMeasure(Fault):
    """The map has no frames with which the recall could be measured."""


class TooFewFrames(Fault):
    """The traverse is too short for sequence matching."""


class TooManyPairs(Fault):
    """The traverses have too many frames to be compared frame by frame."""


class TooManyWatchers(Fault):
    """Too many clients follow jobs."""


class TooManyListeners(Fault):
    """Too many clients listen to the events of maps."""


class UnknownSession(Fault):
    """The map has no session of this id."""


class SessionExpired(Fault):
    """The session has ended, because no frame came for too long or its map was replaced."""


class TooManySessions(Fault):
    """Too many sessions are open, or they hold too much memory."""


class StreamTaken(Fault):
    """Another connection already streams into the session."""


class SessionOfAnother(Fault):
    """The session was begun with another key."""


class KeyNeeded(Fault):
    """The service needs a key, and the request has none or a malformed one."""

    headers: ClassVar = {"WWW-Authenticate": 'Bearer realm="placerec"'}


class KeyRefused(Fault):
    """The key is unknown, expired or revoked."""

    headers: ClassVar = {"WWW-Authenticate": 'Bearer realm="placerec", error="invalid_token"'}


class RoleTooLow(Fault):
    """The key's role does not allow the operation."""


class MapForbidden(Fault):
    """The key is limited to other maps."""


class ForeignPage(Fault):
    """While there are no keys: the request comes from a web page of another site, or is sent to another host name."""


class UnknownKey(InvalidRequest):
    """No key of this id or name was ever created."""


class KeyExists(InvalidRequest):
    """Another key in force has the name."""


class FirstKeyLocal(Fault):
    """The service has no keys and other machines can reach it, so none of them may create the first one."""


class KeyEnded(Fault):
    """The key is revoked or has expired, so it cannot be changed."""


class KeyWidened(Fault):
    """The change would let the holder of a key do more than before."""


class LastAdminKey(Fault):
    """After the change no key could manage the service any more, and the caller did not say that this is wanted."""


class TooManyKeys(Fault):
    """As many keys were created as the file of the keys may hold."""


class KeysUnreadable(Fault):
    """The file of the keys is damaged, missing or unreadable, so nobody is let in."""

    public = "The keys cannot be read, so nobody is let in; the log of the service says why."


class RateExceeded(Fault):
    """The caller sends more requests a second than it may.

    Args:
        seconds: time until the next request is accepted.
    """

    def __init__(self, detail: str, seconds: float) -> None:
        super().__init__(detail)
        self.headers = {"Retry-After": str(max(1, math.ceil(seconds)))}


class MalformedHead(Fault):
    """The head of the request is not valid HTTP, or not a valid WebSocket handshake.

    Args:
        headers: headers of the answer.
    """

    def __init__(self, detail: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(detail)
        self.headers = headers or {}


class UnknownTransferCoding(Fault):
    """The body is sent in a transfer coding that is not known."""


class HeadTooSlow(Fault):
    """The head of the request did not arrive in time."""


class HeadTooLarge(Fault):
    """The request has too many headers, or too many bytes of them."""


class UrlTooLong(Fault):
    """The path and the query string are longer than the limit."""


class TooManyConnections(Fault):
    """Too many connections are open, of all clients or from this client's address."""


class TooManyMaps(Fault):
    """The service already has the most maps that it may have."""


class TooManyPlaces(Fault):
    """The map already has the most places that it may have."""


class PlanTooLarge(Fault):
    """The plan would list more places than one answer may."""


class NotLocalized(Fault):
    """The frame was not recognized, and the caller takes nothing but a pose."""


class NoGeoPose(Fault):
    """The answer has no GeoPose, and the caller takes nothing else."""


class TooManyExports(Fault):
    """The most exports that may be stored are already being downloaded."""


class TooManyImports(Fault):
    """The most imports are already under way or wait for a job."""


class ExportGone(Fault):
    """The export of which the caller has a part is no longer stored."""


class DigestMismatch(Fault):
    """The body does not match the digest that the caller gives."""


class RangeNotSatisfiable(Fault):
    """The range begins after the end.

    Args:
        size: number of bytes of the content.
    """

    def __init__(self, detail: str, size: int) -> None:
        super().__init__(detail)
        self.headers = {"Content-Range": f"bytes */{size}"}


class Stopping(Fault):
    """The service stopped before the request was done."""
