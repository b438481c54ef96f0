"""Server-sent events, taken from the bytes of a stream."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from placerec_client.errors import UnexpectedAnswer

MOST_BYTES = 16 << 20
"""Bytes of one event, beyond which the stream is not believed."""


@dataclass(frozen=True)
class Event:
    """One event: its name, its data and its id, by which a stream is taken up again."""

    name: str
    data: str
    id: str | None

    def json(self) -> dict[str, Any]:
        """The data as an object.

        Raises:
            UnexpectedAnswer: it is none.
        """
        try:
            found = json.loads(self.data)
        except ValueError as error:
            raise UnexpectedAnswer(f"An event is not JSON: {error}") from error
        if not isinstance(found, dict):
            raise UnexpectedAnswer("An event is not a JSON object.")
        return found


@dataclass(frozen=True)
class MapEvent:
    """An event of a map.

    Attributes:
        kind: ``query``, ``enrolment``, ``session``, ``job`` or ``map``; of the stream itself, ``listening`` or
            ``missed``.
        id: by which the stream is taken up again.
        data: the fields that docs/reference/events.md lists.
    """

    kind: str
    id: str | None
    data: dict[str, Any]


class Reader:
    """Takes the events from the chunks of a stream."""

    def __init__(self) -> None:
        self._waiting = b""

    def take(self, chunk: bytes) -> Iterator[Event]:
        """Yield the events that a chunk completes.

        Raises:
            UnexpectedAnswer: an event is longer than any service sends.
        """
        self._waiting = (self._waiting + chunk).replace(b"\r\n", b"\n")
        *whole, self._waiting = self._waiting.split(b"\n\n")
        if len(self._waiting) > MOST_BYTES:
            raise UnexpectedAnswer("An event is too long.")
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
