"""Limits on requests a second: a token bucket for each caller, in bounded memory."""

from __future__ import annotations

import ipaddress
import time
from collections import OrderedDict
from collections.abc import Callable
from functools import lru_cache

from service.errors.faults import RateExceeded

MOST_CALLERS = 4096
"""Buckets that are kept; the least recently used one makes room for another."""

FAILURES_PER_SECOND, FAILURE_BURST = 1.0, 10
"""How many wrong keys one address may try."""


class Buckets:
    """Token buckets by name.  A bucket holds up to ``burst`` tokens, and ``rate`` tokens are added each second.

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
        """Take a token and return 0.0; if there is none, return the seconds until there will be one."""
        if not self.rate:
            return 0.0
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


class Rates:
    """The limits of one service.

    Args:
        rate, burst: the limit of each key, or of each address while there are no keys.
    """

    def __init__(self, rate: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._requests = Buckets(rate, burst, clock)
        self._failures = Buckets(FAILURES_PER_SECOND, FAILURE_BURST, clock)

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
