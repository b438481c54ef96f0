"""The live events of all maps.

No event is stored of a map without listeners: a request then costs the question whether there is a feed.  The feed of
a map begins with its first listener, and stays for a while after the last one, so that a listener whose connection
broke can go on where it was.  Listeners read from the feed; nobody waits for them.
"""

from __future__ import annotations

import base64
import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from core.errors import PlacerecError
from core.frames.images import ANY_SIZE, decode, encode_thumbnail
from core.frames.value_ranges import few_values
from service.errors.faults import TooManyListeners
from service.events.feed import Feed, FeedEvent, Listener
from service.events.relay import EventRelay
from service.events.schemas import PRIVATE, Event, QueryEvent
from service.fairness import Holding, SharedRoom

LINGER_SECONDS = 120.0
"""How long the events of a map are stored after its last listener has left."""

PICTURE_SIDE, PICTURE_QUALITY = 160, 70
"""Longer side in pixels and JPEG quality of the pictures of frames."""

MOST_DRAWING, MOST_DRAWING_BYTES = 8, 32 << 20
"""The most frames, and bytes of their files, of which pictures are being made; further events go without one."""

NOWHERE: Mapping[str, bool] = {}

log = logging.getLogger("placerec.events")


class Events:
    """The feeds of the maps that somebody listens to.  Any thread may publish; nobody is ever blocked by a listener.

    Args:
        most_listeners: how many clients may listen at one time.
        clock: seconds, never going back.
        relay: brings the events to listeners at other services, and theirs here; None: there are no other services.
    """

    def __init__(
        self,
        most_listeners: int = 64,
        clock: Callable[[], float] = time.monotonic,
        relay: EventRelay | None = None,
    ) -> None:
        self._room, self._clock, self._relay = SharedRoom(most_listeners), clock, relay
        self._feeds: dict[str, Feed] = {}
        self._lock = threading.Lock()
        self._drawing = self._drawing_bytes = 0
        self._artist: ThreadPoolExecutor | None = None
        self.stopping = False
        if relay is not None:
            relay.serve(self)

    @property
    def listeners(self) -> int:
        """The number of clients that listen."""
        return self._room.held

    @property
    def _elsewhere(self) -> Mapping[str, bool]:
        """The maps with listeners at other services, and whether they want pictures."""
        return NOWHERE if self._relay is None else self._relay.elsewhere

    def heard(self, map_id: str) -> bool:
        """Whether an event of a map would be sent or stored; call this before an event is made."""
        return map_id in self._feeds or (self._relay is not None and map_id in self._relay.elsewhere)

    def publish(self, event: Event, frame: bytes | None = None, maps: frozenset[str | None] | None = None) -> None:
        """Tell an event to the listeners of its map, if it is heard.

        Args:
            frame: the file of the frame that a query was about, if a picture of it may be shown.
            maps: ids of the maps that a caller must be allowed to use to see it; None: its own map.
        """
        feed = self._feeds.get(event.map)
        if feed is not None and self._is_forgotten(event.map, feed):
            feed = None
        if feed is None and event.map not in self._elsewhere:
            return
        if frame is not None and self._shows_pictures(event.map, feed) and self._may_draw(len(frame)):
            try:
                self._thread().submit(self._draw, feed, event, frame, maps)
            except RuntimeError:  # the service stops
                return
        else:
            self._add(feed, event, maps, None)

    def _shows_pictures(self, map_id: str, feed: Feed | None) -> bool:
        """Whether somebody wants pictures of the frames of a map."""
        return self._elsewhere.get(map_id, False) or (feed is not None and feed.shows_pictures)

    def _add(self, feed: Feed | None, event: Event, maps: frozenset[str | None] | None, picture: str | None) -> None:
        # ASCII, since some clients take characters such as U+2028 for the end of a line.
        full = event.model_dump_json(ensure_ascii=True)
        public = event.model_dump_json(ensure_ascii=True, exclude=set(PRIVATE))
        verdict = event.verdict if isinstance(event, QueryEvent) else None
        stored = FeedEvent(0, event.kind, verdict, maps or frozenset({event.map}), full, public, picture)
        self._store(feed, stored)
        if self._relay is not None:
            self._relay.send(event.map, stored)

    def _store(self, feed: Feed | None, event: FeedEvent) -> None:
        """Add an event to the feed of its map, if the map has one."""
        with self._lock:
            if feed is not None and not feed.ended:
                feed.add(event)

    # Events of other services

    def listened(self) -> dict[str, bool]:
        """The maps that have a feed, and whether a listener wants pictures."""
        with self._lock:
            self._drop_left()
            return {map_id: feed.shows_pictures for map_id, feed in self._feeds.items()}

    def receive(self, map_id: str, event: FeedEvent | None) -> None:
        """Add an event of another service to the feed of its map; None: the map was deleted."""
        if event is None:
            self._end(map_id)
        else:
            self._store(self._feeds.get(map_id), event)

    def _is_forgotten(self, map_id: str, feed: Feed) -> bool:
        """Drop a feed that nobody has listened to for a while; whether it was dropped."""
        if feed.left_at is None or self._clock() - feed.left_at < LINGER_SECONDS:
            return False
        with self._lock:
            if feed.listeners or self._feeds.get(map_id) is not feed:
                return False
            del self._feeds[map_id]
        return True

    # Pictures

    def _may_draw(self, size: int) -> bool:
        with self._lock:
            room = self._drawing < MOST_DRAWING and self._drawing_bytes + size <= MOST_DRAWING_BYTES
            if room and not self.stopping:
                self._drawing, self._drawing_bytes = self._drawing + 1, self._drawing_bytes + size
                return True
        return False

    def _thread(self) -> ThreadPoolExecutor:
        with self._lock:
            if self._artist is None:
                self._artist = ThreadPoolExecutor(1, "event-pictures")
            return self._artist

    def _draw(self, feed: Feed | None, event: Event, frame: bytes, maps: frozenset[str | None] | None) -> None:
        picture = None
        try:
            small = encode_thumbnail(decode(frame, ANY_SIZE, few_values(frame)), PICTURE_SIDE, PICTURE_QUALITY)
            picture = f"data:image/jpeg;base64,{base64.b64encode(small).decode()}"
        except (PlacerecError, MemoryError) as error:
            log.warning("a frame cannot be shown to listeners: %s", error)
        finally:
            with self._lock:
                self._drawing, self._drawing_bytes = self._drawing - 1, self._drawing_bytes - len(frame)
            self._add(feed, event, maps, picture)

    # Listeners

    @contextmanager
    def listening(self, map_id: str, resumed: str | None = None, pictures: bool = False) -> Iterator[Listener]:
        """A listener of a map; use this on an event loop.

        If too many listen, the latest listener of the caller that has most of them has to go.

        Args:
            resumed: the id of the last event that the listener has seen.
            pictures: whether it wants pictures of the frames of queries.

        Raises:
            TooManyListeners: too many clients listen already.
        """
        with self._lock:
            if not self._room.has_room(share=map_id):
                raise TooManyListeners("Too many clients listen to events already; try again later.")
            feed = self._feeds.setdefault(map_id, Feed(self._lock))
            feed.left_at = None
            listener = Listener(feed, resumed, pictures)
            holding = Holding(listener.give_way, map_id)
            self._room.take(holding)
            feed.listeners.append(listener)
            self._drop_left()
        self._say_listeners_changed()
        try:
            yield listener
        finally:
            with self._lock:
                self._room.release(holding)
                feed.listeners.remove(listener)
                if not feed.listeners:
                    feed.left_at = self._clock()
            self._say_listeners_changed()

    def _say_listeners_changed(self) -> None:
        if self._relay is not None:
            self._relay.listeners_changed()

    def _drop_left(self) -> None:
        """Drop the feeds without listeners that were left for long, and the longest left ones if they are too many."""
        now = self._clock()
        left = sorted((feed.left_at, map_id) for map_id, feed in self._feeds.items() if feed.left_at is not None)
        for index, (moment, map_id) in enumerate(left):
            if now - moment >= LINGER_SECONDS or len(left) - index > self._room.capacity:
                del self._feeds[map_id]

    def forget(self, map_id: str) -> None:
        """Drop the events of a map that are stored for listeners; those who have not read them miss them."""
        with self._lock:
            if (feed := self._feeds.get(map_id)) is not None:
                feed.forget(None)

    def forget_before(self, moment: float) -> None:
        """Drop the events of all maps from before a moment, in seconds since 1970."""
        with self._lock:
            for feed in self._feeds.values():
                feed.forget(moment)

    def end(self, map_id: str) -> None:
        """End the streams of a map that was deleted; earlier events are still read."""
        self._end(map_id)
        if self._relay is not None:
            self._relay.send(map_id, None)

    def _end(self, map_id: str) -> None:
        with self._lock:
            feed = self._feeds.pop(map_id, None)
            if feed is not None:
                feed.ended = True
                feed.wake()

    def stop_soon(self) -> None:
        """End all streams; returns at once."""
        self.stopping = True
        with self._lock:
            artist, feeds = self._artist, list(self._feeds.values())
            for feed in feeds:
                feed.wake()
        if artist is not None:
            artist.shutdown(wait=False, cancel_futures=True)
