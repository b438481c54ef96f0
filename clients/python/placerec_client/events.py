"""Server-sent events, taken from the bytes of a stream."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

MOST_BYTES = 16 << 20
"""Bytes of one event, beyond which the stream is not believed."""


@dataclass(frozen=True)
class Event:
    """One event: its name, its data and its id, by which a stream is taken up again."""

    name: str
    data: str
    id: str | None


class Reader:
    """Takes the events from the chunks of a stream."""

    def __init__(self) -> None:
        self._waiting = b""

    def take(self, chunk: bytes) -> Iterator[Event]:
        """Yield the events that a chunk completes.

        Raises:
            ValueError: an event is longer than any service sends.
        """
        self._waiting += chunk.replace(b"\r\n", b"\n")
        *whole, self._waiting = self._waiting.split(b"\n\n")
        if len(self._waiting) > MOST_BYTES:
            raise ValueError("An event is too long.")
        for block in whole:
            event = _event(block.decode("utf-8", "replace"))
            if event.data:
                yield event


def _event(block: str) -> Event:
    found: dict[str, list[str]] = {}
    for line in block.split("\n"):
        name, colon, value = line.partition(":")
        if name and colon:
            found.setdefault(name, []).append(value.removeprefix(" "))
    ids = found.get("id")
    return Event(
        "".join(found.get("event", ["message"])[-1:]), "\n".join(found.get("data", [])), ids[-1] if ids else None
    )
