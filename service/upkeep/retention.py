"""Deletion of what has been stored for as long as the settings say: in a thread, at the start and then every hour."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import partial

from core.errors import PlacerecError
from core.store import Map
from service.administration.audit_trail import AuditTrail
from service.settings import Settings
from service.upkeep.erasure import Rooms

INTERVAL_SECONDS = 3600.0

AT_ONCE = 100
"""Pictures of places that are deleted in one commit."""

log = logging.getLogger("placerec.retention")


class Retention:
    """Deletes what is older than the settings allow, of all maps and services that this one shares state with.

    Args:
        audit: returns the trail; None while there is none.
    """

    def __init__(self, settings: Settings, rooms: Rooms, audit: Callable[[], AuditTrail | None]) -> None:
        self._settings, self._rooms, self._audit = settings, rooms, audit
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="retention", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """Stop after the present commit."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._stopping.is_set():
            self.apply(datetime.now(UTC))
            self._stopping.wait(INTERVAL_SECONDS)

    def apply(self, now: datetime) -> None:
        """Delete what is too old at a moment; what cannot be deleted is logged, and deleted the next time."""
        given = self._settings
        self._rooms.engine.reserve.hold()
        events, answers = self._rooms.engine.events, self._rooms.statistics.recent
        self._delete("events", given.event_days, now, lambda moment: events.forget_before(moment.timestamp()))
        self._delete("answers", given.answer_days, now, answers.forget_before)
        if (trail := self._audit()) is not None:
            self._delete("the audit trail", given.audit_days, now, trail.forget_before)
        if given.review_days or given.picture_days:
            for map_ in self._maps():
                name = f"of map {map_.record.id}"
                self._delete(f"frames for review {name}", given.review_days, now, map_.review.drop_before)
                self._delete(f"pictures {name}", given.picture_days, now, partial(self._pictures, map_))

    def _delete(self, what: str, days: float, now: datetime, delete: Callable[[datetime], object]) -> None:
        if not days or self._stopping.is_set():
            return
        try:
            delete(now - timedelta(days=days))
        except PlacerecError as error:
            log.warning("%s cannot be shortened: %s", what, error)
        except Exception:  # a defect, which must not end the thread
            log.exception("%s cannot be shortened", what)

    def _maps(self) -> list[Map]:
        maps = self._rooms.engine.maps
        try:
            return [maps.find(record.id) for record in self._rooms.engine.all_records()]
        except PlacerecError as error:
            log.warning("maps cannot be looked at for what is too old: %s", error)
            return []

    def _pictures(self, map_: Map, moment: datetime) -> None:
        while not self._stopping.is_set() and map_.drop_pictures(moment, AT_ONCE):
            pass
