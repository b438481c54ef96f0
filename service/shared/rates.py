"""Limits of requests a second that hold over any number of services.

Each service decides by buckets in its own memory, so that no request waits for PostgreSQL.  Several times a second it
adds what it let through to the common buckets, and learns how full they are.  In a time t all services together so let
through at most rate · t + n · (burst + rate · T) requests of a key, with n services and T between two exchanges; what
was too much in the one is held back in the next, so that over a long time the rate is exact.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from core.errors import StorageFailure, StorageFull
from service.access.gate import FAILURE_BURST, FAILURES_PER_SECOND, MOST_CALLERS, Buckets, Rates
from service.shared.database import SharedDatabase

EXCHANGE_SECONDS = 0.2
TIDYING_SECONDS = 60.0

_ADD = (
    "INSERT INTO service.rates AS r (name, full_at)"
    " SELECT name, now() + make_interval(secs => seconds) FROM unnest(%s::text[], %s::float8[]) AS t (name, seconds)"
    " ORDER BY name ON CONFLICT (name) DO UPDATE SET full_at = greatest(r.full_at, now()) + (excluded.full_at - now())"
    " RETURNING name, extract(epoch FROM full_at - now())::float8"
)

log = logging.getLogger("placerec.shared")


class SharedBuckets(Buckets):
    """Buckets that are shared with other services.  Any thread may use them.

    Args:
        kind: distinguishes them from others in the database.
    """

    def __init__(
        self,
        database: SharedDatabase,
        kind: str,
        rate: float,
        burst: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(rate, burst, clock)
        self._database, self._kind = database, kind
        self._taken: dict[str, int] = {}  # since the last exchange
        self._lock = threading.Lock()

    def take(self, name: str) -> float:
        if not self.rate:
            return 0.0
        with self._lock:
            wait = super().take(name)
            if not wait and (name in self._taken or len(self._taken) < MOST_CALLERS):
                self._taken[name] = self._taken.get(name, 0) + 1
        return wait

    def exchange(self) -> None:
        """Add what was taken here to the common buckets, and learn how full they are.

        Raises:
            StorageFull, StorageFailure: PostgreSQL cannot be reached; it is added the next time.
        """
        with self._lock:
            taken, self._taken = self._taken, {}
        if not taken:
            return
        names = [f"{self._kind} {name}" for name in taken]
        try:
            found = self._database.query(
                "exchange rates", _ADD, (names, [count / self.rate for count in taken.values()])
            )
        except BaseException:
            with self._lock:
                for name, count in taken.items():
                    self._taken[name] = self._taken.get(name, 0) + count
            raise
        with self._lock:
            for name, seconds in found:
                own = name.removeprefix(f"{self._kind} ")
                if own in self._full_at:
                    self._full_at[own] = self._clock() + seconds + self._taken.get(own, 0) / self.rate


class SharedRates(Rates):
    """The limits of all services together.

    Args:
        rate, burst: the limit of each key, or of each address while there are no keys.
    """

    def __init__(self, database: SharedDatabase, rate: float, burst: int) -> None:
        self._database = database
        self._requests: SharedBuckets = SharedBuckets(database, "request", rate, burst)
        self._failures: SharedBuckets = SharedBuckets(database, "failure", FAILURES_PER_SECOND, FAILURE_BURST)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._exchange_on, name="rates", daemon=True)

    def __enter__(self) -> SharedRates:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()

    def exchange(self) -> None:
        """Exchange both kinds of buckets with the other services."""
        self._requests.exchange()
        self._failures.exchange()

    def _exchange_on(self) -> None:
        tidied = time.monotonic()
        while not self._stopping.wait(EXCHANGE_SECONDS):
            try:
                self.exchange()
                if time.monotonic() - tidied > TIDYING_SECONDS:
                    tidied = time.monotonic()
                    self._database.query("forget rates", "DELETE FROM service.rates WHERE full_at < now()")
            except (StorageFull, StorageFailure) as error:
                log.warning("the rate limits hold for this service alone: %s", error)
