"""How many requests a second a caller may send: a token bucket each, in bounded memory."""

from __future__ import annotations

import ipaddress
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import lru_cache

from service.errors.faults import RateExceeded

MOST_CALLERS = 4096
"""Buckets that are kept; the one that was asked longest ago makes room for another."""

FAILURES_PER_SECOND, FAILURE_BURST = 1.0, 10
"""Wrong keys that one address may try."""


class Buckets:
    """Token buckets by name.  A full one holds ``burst`` tokens and ``rate`` more come each second.

    Args:
        rate: tokens a second; 0 means that there is no limit.
        clock: seconds, never going back.
    """

    def __init__(self, rate: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.rate, self.burst, self._clock = rate, max(1, burst), clock
        self._full_at: OrderedDict[str, float] = OrderedDict()

    def __len__(self) -> int:
        return len(self._full_at)

    def take(self, name: str) -> float:
        """Take a token; 0.0 if there was one, else the seconds until there will be, and none is taken."""
        if not self.rate:
            return 0.0
        now = self._clock()
        # One number is a bucket's whole state: when it will be full again.
        full_at = max(self._full_at.get(name, now), now) + 1 / self.rate
        lacking = full_at - now - self.burst / self.rate
        if lacking > 1e-9:
            return lacking
        self._full_at[name] = full_at
        self._full_at.move_to_end(name)
        if len(self._full_at) > MOST_CALLERS:
            self._full_at.popitem(last=False)
        return 0.0


class Rates:
    """The limits of one service.

    Args:
        rate, burst: of each key, and of each address where there are no keys.
    """

    def __init__(self, rate: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._requests = Buckets(rate, burst, clock)
        self._failures = Buckets(FAILURES_PER_SECOND, FAILURE_BURST, clock)

    def admit(self, caller: str) -> None:
        """Count a request.

        Raises:
            RateExceeded: one too many; it is not counted.
        """
        wait = self.wait(caller)
        if wait:
            raise RateExceeded(f"More than {self._requests.rate:g} requests a second; wait a little.", wait)

    def wait(self, caller: str) -> float:
        """Count a request; 0.0 if it may go on, else seconds to wait before asking again."""
        return self._requests.take(caller)

    def admit_failure(self, address: str | None) -> None:
        """Count a wrong key.

        Raises:
            RateExceeded: this address has sent too many; right keys from it are taken all the same.
        """
        wait = self._failures.take(network_of(address))
        if wait:
            raise RateExceeded("Too many wrong keys came from this address; wait a little.", wait)


@lru_cache(MOST_CALLERS)
def network_of(address: str | None) -> str:
    """What counts as one caller: an IPv4 address, or the /64 that an IPv6 host has to itself."""
    try:
        parsed = ipaddress.ip_address(address or "")
    except ValueError:
        return address or "unknown"
    if isinstance(parsed, ipaddress.IPv6Address):
        return str(parsed.ipv4_mapped or ipaddress.ip_network((parsed, 64), strict=False))
    return str(parsed)
