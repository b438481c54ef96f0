"""What the service itself refuses, besides the errors of the core; one class each.

``service.errors.problems`` maps them, as it does the core's, to status codes and problem types.
"""

from __future__ import annotations

import math
from typing import ClassVar


class Fault(Exception):
    """Base of all classes below; the text is one plain sentence for the caller."""


class MalformedBody(Fault):
    """The body cannot be parsed: broken JSON, broken multipart."""


class InvalidRequest(Fault):
    """Parameters, headers or the body's contents do not fit the contract.

    Args:
        detail: one sentence.
        errors: ``{"location": …, "message": …}`` for each thing that is wrong.
    """

    def __init__(self, detail: str, errors: list[dict[str, str]] | None = None) -> None:
        super().__init__(detail)
        self.errors = errors or []


class UnsupportedMediaType(Fault):
    """The content type is not one that this resource takes, or the bytes are of another type than it says."""


class BodyTooLarge(Fault):
    """More bytes than the limit for this resource; the rest was not read."""


class QueueFull(Fault):
    """So many requests wait for the encoder that one more would wait too long."""


class MemoryFull(Fault):
    """So many bytes of uploads are held that this one has to wait."""


class DeadlineExceeded(Fault):
    """The request's time was up before its frame was encoded; nothing was done."""


class ClientGone(Fault):
    """The caller hung up before its turn came; nobody reads the answer."""


class NotReady(Fault):
    """A readiness check fails.

    Args:
        checks: the outcome of each check, "ok" or what is wrong.
    """

    def __init__(self, detail: str, checks: dict[str, str]) -> None:
        super().__init__(detail)
        self.checks = checks


class EncoderNotInstalled(Fault):
    """The map is bound to an encoder that this installation lacks."""


class FrameNeeded(Fault):
    """A place was to keep its frame, which was named by a digest, but holds another one or is not there."""


class BatchOutOfOrder(Fault):
    """A batch was to come after another one, which is not stored; nothing of it was."""


class UnknownExplanation(Fault):
    """There is no picture of an explanation under this name, or not any more."""


class PlaceTaken(Fault):
    """The id is that of a place with another frame, which is not to be replaced."""


class UnknownJob(Fault):
    """There is no job of this id, or it ended so long ago that it is forgotten."""


class JobEnded(Fault):
    """The job has ended, so there is nothing to cancel."""


class JobQueueFull(Fault):
    """So many jobs wait that one more is not taken."""


class StagingFull(Fault):
    """What waits on disk to be worked through takes so much room that this has to wait."""


class JobLost(Fault):
    """The service ended before the job did, and a job of this kind cannot be taken up again."""


class ImagesMissing(Fault):
    """The map does not keep the image of every place, so it cannot be encoded anew."""


class MergeConflict(Fault):
    """The maps cannot be merged as they are: ids, sequences or cameras of the same name mean different things."""


class NothingToMeasure(Fault):
    """The map holds no frames by which the recall could be measured."""


class TooManyWatchers(Fault):
    """So many follow jobs already that one more is not served."""


class UnknownSession(Fault):
    """The map has no session of this id."""


class SessionExpired(Fault):
    """The session is over: nothing came for too long, or its map is another one now."""


class TooManySessions(Fault):
    """So many sessions are kept, or they hold so much memory, that one more has to wait for another to end."""


class FrameOutOfOrder(Fault):
    """The frame is older than one that the session has taken in, or was taken in already."""


class StreamTaken(Fault):
    """Another connection streams into the session."""


class KeyNeeded(Fault):
    """The request carries no key, or none that can be read, and keys are demanded."""

    headers: ClassVar = {"WWW-Authenticate": 'Bearer realm="placerec"'}


class KeyRefused(Fault):
    """The key is unknown, expired or revoked."""

    headers: ClassVar = {"WWW-Authenticate": 'Bearer realm="placerec", error="invalid_token"'}


class RoleTooLow(Fault):
    """The key's role does not allow the operation."""


class MapForbidden(Fault):
    """The key is limited to other maps."""


class ForeignPage(Fault):
    """Without keys: the request comes from a page of another site, or was addressed to another host's name."""


class KeysUnreadable(Fault):
    """The file of the keys is damaged, gone or cannot be read, so nobody can be let in."""


class RateExceeded(Fault):
    """The caller sends more requests a second than it may.

    Args:
        seconds: after which the next one would be taken.
    """

    def __init__(self, detail: str, seconds: float) -> None:
        super().__init__(detail)
        self.headers = {"Retry-After": str(max(1, math.ceil(seconds)))}


class MalformedHead(Fault):
    """The head of the request is not HTTP, or asks for a WebSocket and not as one is asked for.

    Args:
        headers: of the answer.
    """

    def __init__(self, detail: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(detail)
        self.headers = headers or {}


class HeadTooSlow(Fault):
    """The head of the request did not come in time."""


class HeadTooLarge(Fault):
    """The request has too many headers, or too many bytes of them."""


class UrlTooLong(Fault):
    """Path and query string are longer than is read."""


class TooManyConnections(Fault):
    """So many connections are open, of all callers or of this one's address, that one more is not served."""


class TooManyMaps(Fault):
    """There are as many maps as there may be."""


class TooManyPlaces(Fault):
    """The map holds as many places as it may."""


class TooManyExports(Fault):
    """As many maps are being downloaded as moments of maps may be kept."""


class TooManyImports(Fault):
    """As many maps are being brought, or wait for a job, as may be."""


class ExportGone(Fault):
    """The moment of the map of which the caller has a part is not kept any more."""


class DigestMismatch(Fault):
    """The body is not the one of which the caller gives the digest."""


class RangeNotSatisfiable(Fault):
    """The range begins behind the end.

    Args:
        size: bytes that there are.
    """

    def __init__(self, detail: str, size: int) -> None:
        super().__init__(detail)
        self.headers = {"Content-Range": f"bytes */{size}"}


class Stopping(Fault):
    """The service was stopped before the request was done, and could not wait any longer."""
