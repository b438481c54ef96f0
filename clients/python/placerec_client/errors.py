"""The errors of calls: every error of this package is a :class:`PlacerecError`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from placerec_client.models import JobView


class PlacerecError(Exception):
    """A call failed; its text is a sentence that says why."""


class ConnectionFailed(PlacerecError):
    """No answer came: the service cannot be reached, or the connection was lost, or it took longer than ``timeout``."""


class ClientClosed(PlacerecError):
    """The client was closed: it sends nothing any more; another one has to be made."""

    def __init__(self) -> None:
        super().__init__("The client was closed; make another one to go on.")


class NotReadyInTime(PlacerecError):
    """The service was not ready within the time that it was waited for; ``__cause__`` is what it said last."""


class DeadlineExceeded(PlacerecError):
    """No answer came before the deadline of the call."""


class UnexpectedAnswer(PlacerecError):
    """An answer came that no placerec service gives, such as the page of a proxy; ``status`` is that of HTTP."""

    def __init__(self, sentence: str, status: int = 200) -> None:
        super().__init__(sentence)
        self.status = status


class InvalidName(PlacerecError, ValueError):
    """Nothing can have this name: it is no text, empty, ``.`` or ``..``, or has a slash. Nothing was sent of it."""

    def __init__(self, name: object, why: str = "it is empty, '.' or '..', or has a slash") -> None:
        shown = ascii(name[:140]) if isinstance(name, str) else ascii(name)[:140]
        super().__init__(f"{shown} is no name: {why if isinstance(name, str) else 'it has to be a text'}.")
        self.name = name


class InvalidParameter(PlacerecError, ValueError):
    """A value is of a type that the call does not take, such as bytes for a text. Nothing was sent of it."""


class InvalidOdometry(PlacerecError, ValueError):
    """Odometry or a motion that the service would refuse: it is of another type, or out of range. Nothing was sent."""


class Renamed(PlacerecError, AttributeError):
    """A method has another name now, which the text says."""

    def __init__(self, kind: str, old: str, new: str) -> None:
        super().__init__(f"{kind}.{old} is {kind}.{new} now: use {new}.")


class InvalidFrame(PlacerecError, ValueError):
    """A frame cannot be sent: it cannot be read, or is an array of another shape than a picture's."""


class TransferFailed(PlacerecError):
    """A file could not be downloaded or written, or has other bytes than the service says."""


class UnreadableFile(TransferFailed, OSError):
    """A file that is to be uploaded cannot be read."""


class JobCancelled(PlacerecError):
    """A job that was waited for was cancelled; ``job`` is its last state."""

    def __init__(self, job: JobView) -> None:
        super().__init__(f"The job {job.id} was cancelled.")
        self.job = job


class Problem(PlacerecError):
    """The service answered with a problem; each kind has a class of its own in :mod:`placerec_client.problems`.

    Attributes:
        status: the HTTP status.
        type: the stable name of the kind, such as ``urn:placerec:problem:unknown-map``.
        slug: its last part, such as ``unknown-map``.
        title: the kind in a few words.
        detail: the fault of this request; also the text of the exception.
        request_id: the id under which the service's log has the request.
        retry_after: seconds after which the request may succeed; None if the service does not say.
        body: the whole problem object.
        after_loss: whether the answer to an earlier attempt of the same request was lost; the earlier attempt may then
            be the reason, as for a map that exists already.
    """

    def __init__(
        self, body: Mapping[str, Any], status: int, retry_after: float | None = None, after_loss: bool = False
    ) -> None:
        self.body = dict(body)
        self.type = str(body.get("type", "about:blank"))
        self.slug = self.type.rpartition(":")[2]
        self.title = str(body.get("title", ""))
        self.detail = str(body.get("detail") or self.title or self.slug)
        self.request_id: str | None = body.get("request_id")
        self.status, self.retry_after, self.after_loss = status, retry_after, after_loss
        super().__init__(self.detail)
