"""What the service itself refuses, besides the errors of the core; one class each.

``service.problems`` maps them, as it does the core's, to status codes and problem types.
"""

from __future__ import annotations


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
