"""The latest events of one map, from which its listeners read at their own pace."""

from __future__ import annotations

import asyncio
import secrets
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice

from service.events.schemas import EventKind

MOST_EVENTS = 1000
"""The most events of one map that are stored for listeners that are slow, or reconnect."""

MOST_BYTES = 4 << 20
"""The most bytes of these events, pictures included."""


@dataclass(frozen=True)
class FeedEvent:
    """An event as a feed stores it.

    number: counts the events of the feed; 0 before it is in one.
    verdict: of a query; None of other kinds.
    maps: ids of the maps that a caller must be allowed to use to see it; None stands for what belongs to no map.
    full, public: the event as a JSON object, and without the fields that not everybody sees.
    picture: a data URL of the frame; None if there is none.
    at: when it came here, in seconds since 1970.
    """

    number: int
    kind: EventKind
    verdict: str | None
    maps: frozenset[str | None]
    full: str
    public: str
    picture: str | None
    at: float = field(default_factory=time.time)

    def data(self, private: bool, pictures: bool) -> str:
        """The JSON object for a listener.

        Args:
            private: whether it sees the callers.
            pictures: whether it gets pictures.
        """
        text = self.full if private else self.public
        if not pictures or self.kind != "query":
            return text
        shown = "null" if self.picture is None else f'"{self.picture}"'
        return f'{text[:-1]},"picture":{shown}}}'

    @property
    def size(self) -> int:
        return len(self.full) + len(self.public) + len(self.picture or "")


@dataclass(frozen=True)
class Read:
    """The events that a listener reads at one time.

    missed: how many events it has lost since it read last; None if that is not known.
    events: the events after those, oldest first.
    before: the id of the event before the first of them.
    """

    missed: int | None
    events: list[FeedEvent]
    before: str


@dataclass(eq=False)
class Feed:
    """The latest events of a map, bounded by number and bytes.  Its owner holds ``lock`` while it is changed.

    epoch: distinguishes it from other feeds, so that an id of another one is noticed.
    left_at: when its last listener left, by the owner's clock; None while it has listeners.
    ended: whether nothing more will come.
    """

    lock: threading.Lock
    epoch: str = field(default_factory=lambda: secrets.token_hex(6))
    number: int = 0
    latest: deque[FeedEvent] = field(default_factory=deque)
    size: int = 0
    listeners: list[Listener] = field(default_factory=list)
    left_at: float | None = None
    ended: bool = False

    def add(self, event: FeedEvent) -> None:
        """Append an event under the next number, and drop the oldest ones beyond the limits."""
        self.number += 1
        event = replace(event, number=self.number)
        self.latest.append(event)
        self.size += event.size
        while len(self.latest) > MOST_EVENTS or (self.size > MOST_BYTES and len(self.latest) > 1):
            self.size -= self.latest.popleft().size
        self.wake()

    def forget(self, before: float | None) -> None:
        """Drop the stored events, or those from before a moment; their numbers are not used again."""
        while self.latest and (before is None or self.latest[0].at < before):
            self.size -= self.latest.popleft().size

    @property
    def shows_pictures(self) -> bool:
        """Whether a listener wants pictures."""
        return any(listener.pictures for listener in self.listeners)

    def wake(self) -> None:
        """Let the listeners look what is new."""
        for listener in self.listeners:
            listener.wake()

    def id_of(self, number: int) -> str:
        """The id of an event."""
        return f"{self.epoch}-{number}"

    def number_of(self, event_id: str) -> int | None:
        """The number of an event by its id; None if the id is not of this feed."""
        epoch, _, number = event_id.partition("-")
        if epoch != self.epoch or not (number.isascii() and number.isdigit()) or len(number) > 18:
            return None
        return int(number) if int(number) <= self.number else None


class Listener:
    """One listener of a feed; only its own task reads.

    Args:
        resumed: the id of the last event that the listener has seen; None: it begins with what happens from now on.
        pictures: whether it wants pictures.
    """

    def __init__(self, feed: Feed, resumed: str | None, pictures: bool) -> None:
        found = None if resumed is None else feed.number_of(resumed)
        self._feed, self.pictures = feed, pictures
        self._lost_track = resumed is not None and found is None
        self._seen = feed.number if found is None else found
        self._loop = asyncio.get_running_loop()
        self.changed = asyncio.Event()
        self.over = False
        """Whether the listener has to go."""

    def give_way(self) -> bool:
        """Let the listener go, so that another caller can listen."""
        self.over = True
        self.wake()
        return True

    @property
    def ended(self) -> bool:
        """Whether nothing more will come, and all was read."""
        return self._feed.ended and self._seen == self._feed.number

    @property
    def position(self) -> str:
        """The id of the last event that was read."""
        return self._feed.id_of(self._seen)

    def id_of(self, event: FeedEvent) -> str:
        """The id of an event, with which a listener can resume."""
        return self._feed.id_of(event.number)

    def wake(self) -> None:
        """Set ``changed``, from any thread."""
        with suppress(RuntimeError):  # its loop has ended
            self._loop.call_soon_threadsafe(self.changed.set)

    def read(self, most: int = 100) -> Read:
        """The events since the last read, at most ``most`` of them."""
        feed = self._feed
        with feed.lock:
            oldest = feed.number - len(feed.latest)
            missed: int | None = max(0, oldest - self._seen)
            if self._lost_track:
                missed, self._lost_track = None, False
            start = max(self._seen, oldest)
            events = list(islice(feed.latest, start - oldest, start - oldest + most))
            self._seen = start + len(events)
            return Read(missed, events, feed.id_of(start))
