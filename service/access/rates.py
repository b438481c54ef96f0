"""Limits of requests a second: of one service or, with a ledger, of all services together.

Each service decides by buckets in its own memory, so that no request waits.  With a ledger it adds what it let through
to the common buckets several times a second, and learns how full they are.  In a time t all services together so let
through at most rate · t + n · (burst + rate · T) requests of a key, with n services and T between two exchanges; what
was too much in the one is held back in the next, so that over a long time the rate is exact.
"""

from __future__ import annotations

import ipaddress
import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import lru_cache

from sqlalchemy import Column, MetaData, Table, bindparam, cast, column, delete, extract, func, select
from sqlalchemy.types import ARRAY, Float, String

from core.errors import StorageFailure, StorageFull
from core.ledger import Ledger, Statement, Tables
from core.ledger.statements import greatest, real, text
from service.errors.faults import RateExceeded

MOST_CALLERS = 4096
"""The largest number of buckets; the least recently used one makes room for another."""

FAILURES_PER_SECOND, FAILURE_BURST = 1.0, 10
"""How many wrong keys one address may try."""

EXCHANGE_SECONDS = 0.2
TIDYING_SECONDS = 60.0

_METADATA = MetaData()
_RATES = Table(
    "rates",
    _METADATA,
    Column("name", text(), primary_key=True),
    Column("full_at", real(), nullable=False),  # seconds since 1970, by the server's clock
    prefixes=["UNLOGGED"],  # a crash of PostgreSQL forgets them
)
TABLES = Tables("rates", 1, _METADATA)
"""Of PostgreSQL alone."""

_NOW = cast(extract("epoch", func.now()), Float(53))  # the same throughout a statement
_TAKEN = (
    func.unnest(bindparam("names", type_=ARRAY(String)), bindparam("seconds", type_=ARRAY(Float(53))))
    .table_valued(column("name", String), column("seconds", Float))
    .render_derived("taken")
)
_ADD = Statement(
    lambda insert: (
        (
            put := insert(_RATES).from_select(
                ["name", "full_at"], select(_TAKEN.c.name, _NOW + _TAKEN.c.seconds).order_by(_TAKEN.c.name)
            )
        )
        .on_conflict_do_update(
            index_elements=["name"],
            set_={"full_at": greatest(_RATES.c.full_at, _NOW) + put.excluded.full_at - _NOW},
        )
        .returning(_RATES.c.name, _RATES.c.full_at - _NOW)
    )
)
_FORGET = Statement(delete(_RATES).where(_RATES.c.full_at < _NOW))

log = logging.getLogger("placerec.shared")


class Buckets:
    """Token buckets by name.  A bucket holds up to ``burst`` tokens, and ``rate`` tokens are added each second.

    One thread takes tokens; another one may exchange them meanwhile.

    Args:
        rate: tokens a second; 0 means that there is no limit.
        clock: seconds, never going back.
        kind: distinguishes them from others in a ledger; None if they are not exchanged with other services.
    """

    def __init__(
        self, rate: float, burst: int, clock: Callable[[], float] = time.monotonic, kind: str | None = None
    ) -> None:
        self.rate, self.burst, self._clock, self._kind = rate, max(1, burst), clock, kind
        self._full_at: OrderedDict[str, float] = OrderedDict()
        self._taken: dict[str, int] = {}  # since the last exchange
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._full_at)

    def take(self, name: str) -> float:
        """Take a token and return 0.0; if there is none, return the seconds until there will be one."""
        if not self.rate:
            return 0.0
        if self._kind is None:
            return self._take(name)
        with self._lock:
            wait = self._take(name)
            if not wait and (name in self._taken or len(self._taken) < MOST_CALLERS):
                self._taken[name] = self._taken.get(name, 0) + 1
        return wait

    def _take(self, name: str) -> float:
        now = self._clock()
        # The state of a bucket is one number: when it will be full again.
        full_at = max(self._full_at.get(name, now), now) + 1 / self.rate
        lacking = full_at - now - self.burst / self.rate
        if lacking > 1e-9:
            return lacking
        self._full_at[name] = full_at
        self._full_at.move_to_end(name)
        if len(self._full_at) > MOST_CALLERS:
            self._full_at.popitem(last=False)
        return 0.0

    def exchange(self, ledger: Ledger) -> None:
        """Add what was taken here to the common buckets, and learn how full they are.

        Raises:
            StorageFull, StorageFailure: the ledger cannot be reached; it is added the next time.
        """
        with self._lock:
            taken, self._taken = self._taken, {}
        if not taken:
            return
        names, seconds = [f"{self._kind} {name}" for name in taken], [count / self.rate for count in taken.values()]
        try:
            found = ledger.execute("exchange rates", _ADD, names=names, seconds=seconds)
        except BaseException:
            with self._lock:
                for name, count in taken.items():
                    self._taken[name] = self._taken.get(name, 0) + count
            raise
        with self._lock:
            for name, left in found:
                own = name.removeprefix(f"{self._kind} ")
                if own in self._full_at:
                    self._full_at[own] = self._clock() + left + self._taken.get(own, 0) / self.rate


class Rates:
    """The limits of requests; a context in which they are exchanged with the other services, if there are any.

    Args:
        rate, burst: the limit of each key, or of each address while there are no keys.
        ledger: that of the services that keep to the limits together.
    """

    def __init__(
        self, rate: float, burst: int, ledger: Ledger | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        kinds = (None, None) if ledger is None else ("request", "failure")
        self._requests = Buckets(rate, burst, clock, kinds[0])
        self._failures = Buckets(FAILURES_PER_SECOND, FAILURE_BURST, clock, kinds[1])
        self._ledger = ledger
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Rates:
        if self._ledger is not None:
            self._thread = threading.Thread(target=self._exchange_on, args=(self._ledger,), name="rates", daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()

    def admit(self, caller: str) -> None:
        """Count a request.

        Raises:
            RateExceeded: the request exceeds the rate; it is not counted.
        """
        wait = self.wait(caller)
        if wait:
            raise RateExceeded(
                f"More than {self._requests.rate:g} requests a second were sent. Wait before you send the next one.",
                wait,
            )

    def wait(self, caller: str) -> float:
        """Count a request and return 0.0, or return the seconds to wait until it can be counted."""
        return self._requests.take(caller)

    def admit_failure(self, address: str | None) -> None:
        """Count a wrong key.

        Raises:
            RateExceeded: this address has sent too many; valid keys from it are still accepted.
        """
        wait = self._failures.take(network_of(address))
        if wait:
            raise RateExceeded("Too many wrong keys were sent from this address. Wait before you try again.", wait)

    def _exchange_on(self, ledger: Ledger) -> None:
        tidied = time.monotonic()
        while not self._stopping.wait(EXCHANGE_SECONDS):
            try:
                self._requests.exchange(ledger)
                self._failures.exchange(ledger)
                if time.monotonic() - tidied > TIDYING_SECONDS:
                    tidied = time.monotonic()
                    ledger.change("forget rates", _FORGET)
            except (StorageFull, StorageFailure) as error:
                log.warning("the rate limits hold for this service alone: %s", error)


@lru_cache(MOST_CALLERS)
def network_of(address: str | None) -> str:
    """The addresses that count as one caller: an IPv4 address, or the /64 network of an IPv6 address."""
    try:
        parsed = ipaddress.ip_address(address or "")
    except ValueError:
        return address or "unknown"
    if isinstance(parsed, ipaddress.IPv6Address):
        return str(parsed.ipv4_mapped or ipaddress.ip_network((parsed, 64), strict=False))
    return str(parsed)
