"""Streams of server-sent events, which are taken up again when they are lost."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Mapping
from typing import Any

from placerec_client import problems
from placerec_client._async.concurrency import sleep
from placerec_client._async.connection import AsyncConnection
from placerec_client.answers import OVERLOADED
from placerec_client.errors import ConnectionFailed, PlacerecError, Problem, UnexpectedAnswer
from placerec_client.events import Event, Reader
from placerec_client.requests import query_string

NO_CONTENT = 204


async def follow(connection: AsyncConnection, path: str, params: Mapping[str, Any]) -> AsyncGenerator[Event]:
    """Yield the events of a stream; a stream that ends is taken up again after the last event, until it says 204.

    Raises:
        Problem: the service refuses the stream.
        ConnectionFailed: the service cannot be reached for as long as the connection's patience lasts.
    """
    last: str | None = None
    failures, waited = 0, 0.0
    while True:
        reader, least = Reader(), 0.0
        headers = {"Accept": "text/event-stream"} | ({} if last is None else {"Last-Event-ID": last})
        try:
            async with connection.stream(path + query_string(params), headers) as response:
                if response.status_code == NO_CONTENT:
                    return
                async for chunk in response.aiter_bytes():
                    for event in reader.take(chunk):
                        failures, waited, last = 0, 0.0, event.id or last
                        yield event
        except PlacerecError as error:
            if not _passes(error) or waited > connection.retry.patience or not connection.retry.patience:
                raise
            least = (isinstance(error, Problem) and error.retry_after) or 0.0
        failures += 1
        pause = max(connection.retry.pause(failures), least)
        waited += pause
        await sleep(pause)


def _passes(error: PlacerecError) -> bool:
    """Whether a stream may be had in a moment: also behind a proxy that answers 502 while the service restarts."""
    if isinstance(error, UnexpectedAnswer):
        return error.status in OVERLOADED
    if isinstance(error, Problem) and error.status in OVERLOADED and error.retry_after is not None:
        return True
    passing = (problems.TooManyWatchers, problems.TooManyListeners, problems.Stopping, problems.NotReady)
    return isinstance(error, (ConnectionFailed, *passing))
