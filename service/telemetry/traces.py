"""The trace of a request (W3C Trace Context), and the ids that every log line of a request has."""

from __future__ import annotations

import random
import re
from collections.abc import Iterable
from contextvars import ContextVar
from dataclasses import dataclass

TRACEPARENT = re.compile(rb"([0-9a-f]{2})-([0-9a-f]{32})-([0-9a-f]{16})-([0-9a-f]{2})(-.*)?")
LONGEST = 512
"""Most bytes of a header; later versions of the standard may make it longer than today."""

_ids = random.Random()


@dataclass(frozen=True)
class Trace:
    """The span of one request in a trace.

    Args:
        trace_id: of the trace, 32 hexadecimal digits.
        parent_id: of the caller's span, 16 hexadecimal digits.
        span_id: of this request's span, 16 hexadecimal digits.
        sampled: whether the caller records its span.
    """

    trace_id: str
    parent_id: str
    span_id: str
    sampled: bool

    @property
    def response(self) -> str:
        """The value of the header ``traceresponse``."""
        return f"00-{self.trace_id}-{self.span_id}-{int(self.sampled):02x}"


def read_trace(headers: Iterable[tuple[bytes, bytes]]) -> Trace | None:
    """The trace of a request by its ``traceparent``; None without one, or if it does not conform to the standard.

    Args:
        headers: names in lower case.
    """
    given = [value for name, value in headers if name == b"traceparent"]
    if len(given) != 1 or len(given[0]) > LONGEST:
        return None
    found = TRACEPARENT.fullmatch(given[0].strip(b" \t"))
    if found is None:
        return None
    version, trace_id, parent_id, flags, more = found.groups()
    if version == b"ff" or (version == b"00" and more is not None):
        return None
    if not int(trace_id, 16) or not int(parent_id, 16):
        return None
    span_id = f"{_ids.randrange(1, 1 << 64):016x}"
    return Trace(trace_id.decode(), parent_id.decode(), span_id, bool(int(flags, 16) & 1))


@dataclass(frozen=True)
class Origin:
    """The ids of the request for which something is done."""

    request_id: str
    trace_id: str | None


origin: ContextVar[Origin | None] = ContextVar("origin", default=None)
"""The origin of what is being done now; threads that work for a request inherit it."""
