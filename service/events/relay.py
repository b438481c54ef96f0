"""Events on their way to and from other services.

A service that has listeners of a map says so; the others then send it their events, by a table of the ledger and a
notice that something new is in it.  Nothing is written of a map that nobody listens to.
"""

from __future__ import annotations

import json
import logging
import threading
from collections import deque
from collections.abc import Mapping
from typing import Protocol

from sqlalchemy import Column, MetaData, Table, bindparam, delete, func, insert, select

from core.errors import StorageFailure, StorageFull
from core.ledger import Ledger, Statement, Tables
from core.ledger.statements import among, integer, real, seconds_now, text
from service.events.feed import FeedEvent
from service.peers.peers import Peers

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

NOT_YET = -1
"""The number of the last event that was received, before anybody has listened here."""

log = logging.getLogger("placerec.shared")


# Tables and statements

_METADATA = MetaData()
_LISTENING = Table(
    "listening",
    _METADATA,
    Column("replica", text(), primary_key=True),
    Column("map", text(), primary_key=True),
    Column("pictures", integer(), nullable=False),
)
_EVENTS = Table(
    "events",
    _METADATA,
    Column("number", integer(), primary_key=True, autoincrement=True),
    Column("replica", text(), nullable=False),  # that sends it
    Column("map", text(), nullable=False),
    Column("event", text()),  # NULL: the map was deleted
    Column("at", real(), nullable=False),
)
_UNLOGGED = [f"ALTER TABLE {table} SET UNLOGGED" for table in _METADATA.tables]
TABLES = Tables("events", 1, _METADATA, more={"postgresql": _UNLOGGED})

_SILENCE = Statement(delete(_LISTENING).where(_LISTENING.c.replica == bindparam("replica")))
_LISTEN = Statement(
    insert(_LISTENING).values(replica=bindparam("replica"), map=bindparam("map"), pictures=bindparam("pictures"))
)
_LISTENED = Statement(
    select(_LISTENING.c.map, func.max(_LISTENING.c.pictures))
    .where(_LISTENING.c.replica != bindparam("replica"), among(_LISTENING.c.replica, "living"))
    .group_by(_LISTENING.c.map)
)
_SEND = Statement(
    insert(_EVENTS)
    .values(replica=bindparam("replica"), map=bindparam("map"), event=bindparam("event"), at=seconds_now())
    .inline()
)
_LATEST = Statement(select(_EVENTS.c.number).order_by(_EVENTS.c.number.desc()).limit(LOOK_BACK))
_RECEIVE = Statement(
    select(_EVENTS.c.number, _EVENTS.c.map, _EVENTS.c.event)
    .where(_EVENTS.c.number > bindparam("after"), _EVENTS.c.replica != bindparam("replica"))
    .where(among(_EVENTS.c.map, "maps"), ~among(_EVENTS.c.number, "received"))
    .order_by(_EVENTS.c.number)
)
_FORGET = Statement(delete(_EVENTS).where(_EVENTS.c.at < seconds_now() - bindparam("seconds")))


class Feeds(Protocol):
    """The feeds of a service."""

    def listened(self) -> dict[str, bool]:
        """The maps that have a feed, and whether a listener wants pictures."""

    def receive(self, map_id: str, event: FeedEvent | None) -> None:
        """Add an event of another service to the feed of its map; None: the map was deleted."""


class EventRelay:
    """Sends the events of a service to those that listen to their maps, and receives theirs.

    Nobody who publishes an event waits for the ledger.

    elsewhere: the maps with listeners at other services, and whether they want pictures.

    Args:
        ledger: shared with the peers; has the ``TABLES``.
    """

    def __init__(self, peers: Peers, ledger: Ledger) -> None:
        self._peers, self._ledger = peers, ledger
        self._feeds: Feeds | None = None
        self.elsewhere: Mapping[str, bool] = {}
        self._said: dict[str, bool] = {}  # the maps that are listened to here, as the others know it
        self._outbox: deque[tuple[str, FeedEvent | None]] = deque(maxlen=MOST_WAITING)
        self._something, self._ending = threading.Event(), False
        self._reached, self._received = NOT_YET, deque[int](maxlen=4 * LOOK_BACK)
        self._sender = threading.Thread(target=self._send_on, name="events", daemon=True)

    def serve(self, feeds: Feeds) -> None:
        """Relay the events of some feeds; call it once, before :meth:`start`."""
        self._feeds = feeds
        self._peers.hear(EVENT, self._receive)
        self._peers.hear(LISTENING, self._look)
        self._peers.every(self._keep_up)

    def start(self) -> None:
        """Begin to send events to other services."""
        self._sender.start()

    def close(self) -> None:
        """Send the events that wait, and stop."""
        self._ending = True
        self._something.set()
        if self._sender.is_alive():
            self._sender.join(5)

    # Events of this service

    def send(self, map_id: str, event: FeedEvent | None) -> None:
        """Send an event to the services that listen to its map; None: the map was deleted."""
        if map_id in self.elsewhere:
            self._outbox.append((map_id, event))
            self._something.set()

    def listeners_changed(self) -> None:
        """Let the others know, soon, which maps are listened to here."""
        self._something.set()

    def _send_on(self) -> None:
        while not self._ending:
            self._something.wait()
            self._something.clear()
            try:
                self._say_who_listens()
                self._send_events()
            except (StorageFull, StorageFailure) as error:
                log.warning("events are not sent to other services: %s", error)
            threading.Event().wait(GATHER_SECONDS)

    def _send_events(self) -> None:
        while self._outbox:
            taken = [self._outbox.popleft() for _ in range(min(len(self._outbox), AT_ONCE))]
            rows = [{"replica": self._peers.id, "map": map_id, "event": _text(event)} for map_id, event in taken]
            with self._ledger.transaction("send events") as connection:
                connection.execute_many(_SEND, rows)
            self._peers.say(EVENT)

    def _say_who_listens(self) -> None:
        assert self._feeds is not None
        now, replica = self._feeds.listened(), self._peers.id
        if now == self._said:
            return
        rows = [{"replica": replica, "map": map_id, "pictures": int(pictures)} for map_id, pictures in now.items()]
        with self._ledger.transaction("say who listens") as connection:
            if self._reached == NOT_YET:  # before others know of it, and thus before they send anything
                latest = [number for (number,) in connection.execute(_LATEST)]
                self._received.extend(latest)
                self._reached = max(latest, default=0)
            connection.execute(_SILENCE, replica=replica)
            connection.execute_many(_LISTEN, rows)
        self._peers.say(LISTENING)
        self._said = now

    # Events of other services

    def _keep_up(self) -> None:
        self._something.set()  # feeds that nobody listens to any more go away by themselves
        self._look(None)
        self._ledger.execute("forget events", _FORGET, seconds=RETENTION_SECONDS)

    def _look(self, _said: str | None) -> None:
        with self._ledger.transaction("see who listens") as connection:
            living = self._peers.living_ids(connection)
            found = connection.execute(_LISTENED, replica=self._peers.id, living=living)
        self.elsewhere = {map_id: bool(pictures) for map_id, pictures in found}

    def _receive(self, _said: str | None) -> None:
        assert self._feeds is not None
        if self._reached == NOT_YET:
            return
        found = self._ledger.execute(
            "read events", _RECEIVE, after=self._reached - LOOK_BACK, replica=self._peers.id,
            maps=list(self._feeds.listened()), received=list(self._received),
        )  # fmt: skip
        for number, map_id, event in found:
            self._reached = max(self._reached, number)
            self._received.append(number)
            self._feeds.receive(map_id, _event(event))


def _text(event: FeedEvent | None) -> str | None:
    if event is None:
        return None
    fields = event.kind, event.verdict, sorted(event.maps, key=str), event.full, event.public, event.picture
    return json.dumps(fields)


def _event(text: str | None) -> FeedEvent | None:
    if text is None:
        return None
    kind, verdict, maps, full, public, picture = json.loads(text)
    return FeedEvent(0, kind, verdict, frozenset(maps), full, public, picture)
