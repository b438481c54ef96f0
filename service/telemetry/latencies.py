"""Latencies of the last minutes, for an operator who looks at the service itself; Prometheus keeps longer histories.

Durations are counted in bins whose bounds grow by five percent, so a quantile is right to two and a half.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

SECONDS = 300
"""The time that is looked back on."""

SLOT_SECONDS = 10
"""Counts are dropped in steps of this many seconds."""

STEP = math.log(1.05)
SHORTEST = 1e-6

Operation = tuple[str, str]
"""The method and the route of a request."""


@dataclass
class LatencyCounts:
    """Durations of the requests of one operation.

    bins: how many fell into each bin.
    errors: how many were answered with a status of 500 or more, or not at all.
    longest: in seconds.
    """

    bins: dict[int, int] = field(default_factory=dict)
    count: int = 0
    errors: int = 0
    longest: float = 0.0

    def observe(self, seconds: float, is_error: bool) -> None:
        """Count one request."""
        number = math.floor(math.log(max(seconds, SHORTEST)) / STEP)
        self.bins[number] = self.bins.get(number, 0) + 1
        self.count += 1
        self.errors += is_error
        self.longest = max(self.longest, seconds)

    def add(self, other: LatencyCounts) -> None:
        """Count the requests of another time, too."""
        for number, count in other.bins.items():
            self.bins[number] = self.bins.get(number, 0) + count
        self.count, self.errors = self.count + other.count, self.errors + other.errors
        self.longest = max(self.longest, other.longest)

    def quantile(self, share: float) -> float:
        """The duration in seconds that a share of the requests does not exceed; 0 without a request."""
        left = share * self.count
        for number in sorted(self.bins):
            left -= self.bins[number]
            if left <= 0:
                return min(self.longest, math.exp((number + 0.5) * STEP))
        return self.longest


class RecentLatencies:
    """Counts requests by operation.  It is used only from the event loop.

    Args:
        clock: seconds, never going back.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._slots: deque[tuple[int, dict[Operation, LatencyCounts]]] = deque(maxlen=SECONDS // SLOT_SECONDS)

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count one request."""
        number = int(self._clock() / SLOT_SECONDS)
        if not self._slots or self._slots[-1][0] != number:
            self._slots.append((number, {}))
        slot = self._slots[-1][1]
        counts = slot.get((method, route))
        if counts is None:
            counts = slot[method, route] = LatencyCounts()
        counts.observe(seconds, status >= 500 or status == 0)

    def read(self) -> dict[Operation, LatencyCounts]:
        """The counts of the last ``SECONDS``, the most frequent operation first."""
        oldest = int(self._clock() / SLOT_SECONDS) - SECONDS // SLOT_SECONDS
        found: dict[Operation, LatencyCounts] = {}
        for number, slot in self._slots:
            if number > oldest:
                for operation, counts in slot.items():
                    found.setdefault(operation, LatencyCounts()).add(counts)
        return dict(sorted(found.items(), key=lambda item: -item[1].count))
