"""When a request is sent again, and how long the client waits before."""

from __future__ import annotations

import random
import time
from dataclasses import dataclass

from placerec_client.errors import InvalidParameter
from placerec_client.requests import seconds_of

LEAVE_SECONDS = 1.0
"""How long leaving a session, with the stream in it, waits for the service."""

SHORTEST_PAUSE = 0.05
"""Seconds between two attempts at least, unless the rule has shorter pauses; no attempt begins later than that before
the end of the time."""


@dataclass(frozen=True)
class Retry:
    """How long a request is repeated while the service is overloaded, restarts, or cannot be reached.

    A request is repeated only where another answer may come: after 429, 502, 503, 504 and a lost connection, always
    under the same ``X-Request-Id``, after pauses that double, with some randomness, and never sooner than the service's
    ``Retry-After`` says. A pause takes at most half of the time that is left, so that attempts go on to the end of it.

    Args:
        patience: seconds after the first attempt in which further ones may begin; 0 sends once. A call with a deadline
            is repeated until its deadline instead.
        first_pause, longest_pause: seconds.

    Raises:
        InvalidParameter: one of them is no number, or less than 0.
    """

    patience: float = 30.0
    first_pause: float = 0.1
    longest_pause: float = 8.0

    def __post_init__(self) -> None:
        for name in ("patience", "first_pause", "longest_pause"):
            if seconds_of(name, getattr(self, name)) < 0:
                raise InvalidParameter(f"{name} has to be 0 seconds or more, not {getattr(self, name):g}.")

    def pause(self, attempt: int) -> float:
        """Seconds to wait after failed attempts, at random between half and one and a half of the nominal."""
        nominal = self.first_pause * 2.0 ** min(attempt - 1, 30)
        return min(nominal, self.longest_pause) * random.uniform(0.5, 1.5)


class Clock:
    """The time of one call.

    Args:
        deadline: seconds until an answer is of no use; None for none.
        retry: for how long the call is repeated if it has no deadline.

    Raises:
        InvalidParameter: the deadline is no number.
    """

    __slots__ = ("_last", "_retry", "_until", "attempts", "deadline", "lost")

    def __init__(self, deadline: float | None, retry: Retry) -> None:
        if deadline is not None:
            deadline = seconds_of("deadline", deadline)
        now = time.monotonic()
        self._until = None if deadline is None else now + deadline
        self._last = now + retry.patience if self._until is None or not retry.patience else self._until
        self._retry = retry
        self.deadline = deadline
        self.attempts = 0
        self.lost = False  # whether the service may have done the request although its answer was lost

    def left(self) -> float | None:
        """Seconds until the deadline; None without one."""
        return None if self._until is None else self._until - time.monotonic()

    def pause(self, least: float | None = None) -> float | None:
        """Seconds to wait before the next attempt; None if there is no time for one.

        Args:
            least: seconds that the service asks to wait, which are never shortened.
        """
        left = self._last - time.monotonic()
        retry = self._retry
        pause = min(retry.pause(self.attempts), left / 2)
        if pause < min(retry.first_pause / 2, retry.longest_pause / 2, SHORTEST_PAUSE):
            return None
        pause = max(pause, least or 0.0)
        return pause if pause < left else None
