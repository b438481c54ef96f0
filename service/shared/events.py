"""Live events over any number of services.

A service that has listeners of a map says so; the others then send it their events, by a table and a notice that
something new is in it.  Nothing is written of a map that nobody listens to.
"""

from __future__ import annotations

import json
import logging
import threading
from collections import deque

from core.errors import StorageFailure, StorageFull
from service.events.events import Events
from service.events.feed import Feed, FeedEvent
from service.peers.replica import ServiceReplica
from service.shared.database import LIVING, SharedDatabase

EVENT, LISTENING = "event", "listening"
"""Topics between services: there are new events, and somebody listens to other maps than before."""

MOST_WAITING = 2000
"""Events that wait to be sent to others; beyond that the oldest ones are dropped."""

GATHER_SECONDS = 0.05
"""Events within this time are sent together."""

AT_ONCE = 500

LOOK_BACK = 1000
"""Events may become visible in another order than that of their numbers, if they are written at the same time."""

RETENTION_SECONDS = 30

log = logging.getLogger("placerec.shared")


class SharedEvents(Events):
    """The feeds of the maps that somebody listens to here, with what happens at all services.

    Nobody who publishes an event waits for PostgreSQL.
    """

    def __init__(self, replica: ServiceReplica, database: SharedDatabase, most_listeners: int) -> None:
        super().__init__(most_listeners)
        self._replica, self._database = replica, database
        self._elsewhere: dict[str, bool] = {}  # maps with listeners at other services; whether they want pictures
        self._said: dict[str, bool] = {}  # the same of this service, as the others know it
        self._outbox: deque[tuple[str, str | None]] = deque(maxlen=MOST_WAITING)
        self._something, self._ending = threading.Event(), False
        self._reached, self._read_lately = -1, deque[int](maxlen=4 * LOOK_BACK)
        self._teller = threading.Thread(target=self._tell_on, name="events", daemon=True)
        replica.hear(EVENT, self._fetch)
        replica.hear(LISTENING, self._look)
        replica.every(self._keep_up)

    def start(self) -> None:
        """Begin to send events to other services."""
        self._teller.start()

    def close(self) -> None:
        """Tell what waits, and stop."""
        self._ending = True
        self._something.set()
        if self._teller.is_alive():
            self._teller.join(5)

    # Events of this service

    def heard(self, map_id: str) -> bool:
        return super().heard(map_id) or map_id in self._elsewhere

    def _heard_elsewhere(self, map_id: str) -> bool:
        return map_id in self._elsewhere

    def _shows_pictures(self, map_id: str, feed: Feed | None) -> bool:
        return self._elsewhere.get(map_id, False) or super()._shows_pictures(map_id, feed)

    def _keep(self, map_id: str, feed: Feed | None, event: FeedEvent) -> None:
        super()._keep(map_id, feed, event)
        if map_id in self._elsewhere:
            self._outbox.append((map_id, _text(event)))
            self._something.set()

    def end(self, map_id: str) -> None:
        super().end(map_id)
        if map_id in self._elsewhere:
            self._outbox.append((map_id, None))
            self._something.set()

    def _listeners_changed(self) -> None:
        self._something.set()

    def _tell_on(self) -> None:
        while not self._ending:
            self._something.wait()
            self._something.clear()
            try:
                self._say_who_listens()
                self._tell_events()
            except (StorageFull, StorageFailure) as error:
                log.warning("events are not sent to other services: %s", error)
            threading.Event().wait(GATHER_SECONDS)

    def _tell_events(self) -> None:
        while self._outbox:
            taken = [self._outbox.popleft() for _ in range(min(len(self._outbox), AT_ONCE))]
            query = (
                "WITH new AS (INSERT INTO service.events (replica, map, event) SELECT %s, * FROM"
                " unnest(%s::text[], %s::text[]) RETURNING number)"
                " SELECT pg_notify('placerec', %s || max(number)) FROM new"
            )
            maps, events = [map_id for map_id, _ in taken], [event for _, event in taken]
            self._database.query("send events", query, (self._replica.id, maps, events, f"{EVENT} "))

    def _say_who_listens(self) -> None:
        with self._lock:
            now = {name: any(listener.pictures for listener in feed.listeners) for name, feed in self._feeds.items()}
        if now == self._said:
            return
        with self._database.text_transaction("say who listens") as connection:
            connection.execute("DELETE FROM service.listening WHERE replica = %s", (self._replica.id,))
            query = "INSERT INTO service.listening SELECT %s, * FROM unnest(%s::text[], %s::boolean[])"
            connection.execute(query, (self._replica.id, list(now), list(now.values())))
            connection.execute("SELECT pg_notify('placerec', %s)", (f"{LISTENING} ",))
        self._said = now

    # Events of other services

    def _keep_up(self) -> None:
        self._something.set()  # feeds that nobody listens to any more go away by themselves
        self._look(None)
        query = "DELETE FROM service.events WHERE at < clock_timestamp() - make_interval(secs => %s)"
        self._database.query("forget events", query, (RETENTION_SECONDS,))

    def _look(self, _said: str | None) -> None:
        query = (
            "SELECT map, bool_or(pictures) FROM service.listening WHERE replica <> %s"
            f" AND replica IN ({LIVING}) GROUP BY map"
        )
        self._elsewhere = dict(self._database.query("see who listens", query, (self._replica.id,)))

    def _fetch(self, _said: str | None) -> None:
        if self._reached < 0:  # whoever listens here does so from now on
            found = self._database.query("read events", "SELECT coalesce(max(number), 0) FROM service.events")
            self._reached = int(found[0][0])
            return
        maps = list(self._feeds)
        query = (
            "SELECT number, map, event FROM service.events WHERE number > %s AND replica <> %s AND map = ANY(%s)"
            " AND number <> ALL(%s) ORDER BY number"
        )
        values = (self._reached - LOOK_BACK, self._replica.id, maps, list(self._read_lately))
        for number, map_id, text in self._database.query("read events", query, values):
            self._reached = max(self._reached, number)
            self._read_lately.append(number)
            if text is None:
                super().end(map_id)
            else:
                super()._keep(map_id, self._feeds.get(map_id), _event(text))


def _text(event: FeedEvent) -> str:
    fields = event.kind, event.verdict, sorted(event.maps, key=str), event.full, event.public, event.picture
    return json.dumps(fields)


def _event(text: str) -> FeedEvent:
    kind, verdict, maps, full, public, picture = json.loads(text)
    return FeedEvent(0, kind, verdict, frozenset(maps), full, public, picture)
