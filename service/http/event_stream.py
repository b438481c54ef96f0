"""Answers of server-sent events, as jobs and maps give them."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from typing import Annotated, Any

from fastapi import Header, Request
from starlette.responses import Response, StreamingResponse

EVENT_STREAM = "text/event-stream"

HEARTBEAT_SECONDS = 3.0
"""A stream sends a comment at least so often, so that connections stay open and a service that hangs is noticed."""

CHECK_SECONDS = 0.5
"""The key of a caller that waits for events is looked at so often."""

OPENING, HEARTBEAT = ": placerec\n\n", ": still there\n\n"

LastEventId = Annotated[
    str | None,
    Header(max_length=64, description="The id of the last event that was received; the stream goes on after it."),
]


def described(text: str) -> dict[str, Any]:
    """The answer 200 of a stream in the OpenAPI document."""
    return {"description": f"Server-sent events. {text}", "content": {EVENT_STREAM: {}}}


def event_text(event_id: str, name: str, data: str) -> str:
    """One event.

    Args:
        data: JSON on one line.
    """
    return f"id: {event_id}\nevent: {name}\ndata: {data}\n\n"


async def set_within(changed: asyncio.Event, seconds: float) -> bool:
    """Whether the event was set within some seconds; clears it."""
    try:
        async with asyncio.timeout(max(0.0, seconds)):
            await changed.wait()
    except TimeoutError:
        return False
    changed.clear()
    return True


async def set_or_refused(changed: asyncio.Event, seconds: float, check_key: Callable[[], object]) -> bool:
    """Whether the event was set within some seconds; clears it.

    Args:
        check_key: raises a Fault if the caller is let in no more, which is raised here soon after.
    """
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        if await set_within(changed, min(left, CHECK_SECONDS)):
            return True
        check_key()
    return False


async def stream_response(request: Request, stream: AsyncIterator[str]) -> Response:
    """The answer that sends a stream of events; to HEAD, the same without the stream.

    An error of the stream before its first text is raised here, so that it is answered as a problem.
    """
    first = await anext(stream)
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    if request.state.method == "HEAD":
        return Response(media_type=EVENT_STREAM, headers=headers)
    return StreamingResponse(_after(first, stream), media_type=EVENT_STREAM, headers=headers)


async def _after(first: str, rest: AsyncIterator[str]) -> AsyncIterator[str]:
    yield first
    async for text in rest:
        yield text
