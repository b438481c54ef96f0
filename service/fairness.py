"""Fairness between callers: who goes next, and who gives way when there is no room for all.

A caller is a key or, without one, an address.  Work that waits is done in turns (:class:`FairQueue`): next is the
caller that was served least, measured in milliseconds of work, so that one caller's many requests, or expensive ones,
delay its own requests and not those of others.  Room that is limited (:class:`SharedRoom`) is all a caller's that is
alone; when it is full, the caller that holds most of it gives way to one that holds less.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field
from itertools import chain
from typing import Generic, TypeVar

Item = TypeVar("Item")

CALLER: ContextVar[str] = ContextVar("caller", default="owner")
"""The caller of the present work; threads and tasks that a request starts inherit it."""

MOST_REMEMBERED = 1024
"""Callers that do not wait, and whose service is remembered."""


class FairQueue(Generic[Item]):
    """The waiting items of several callers, in turns.  Not thread-safe.

    The items of one caller stay in their order.  A caller that comes anew begins level with the one whose turn was
    last, so that nobody saves up turns by being idle, and nobody loses what it owes by going away for a moment.
    """

    def __init__(self) -> None:
        self._waiting: dict[str, deque[Item]] = {}
        self._served: dict[str, float] = {}  # milliseconds, counted from a common beginning
        self._level = 0.0  # of the caller whose turn was last
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Item]:
        """The items, those of one caller after those of another."""
        return chain.from_iterable(self._waiting.values())

    @property
    def callers(self) -> int:
        """The number of callers that have items."""
        return len(self._waiting)

    def add(self, caller: str, item: Item) -> None:
        """Add an item behind the others of its caller."""
        self._count += 1
        if (queue := self._waiting.get(caller)) is not None:
            queue.append(item)
            return
        self._enter(caller)
        self._waiting[caller] = deque([item])

    def _enter(self, caller: str) -> float:
        """Let a caller begin at the common level, unless it was served more already."""
        if len(self._served) > MOST_REMEMBERED:
            self._forget()
        served = self._served[caller] = max(self._level, self._served.get(caller, 0.0))
        return served

    def _forget(self) -> None:
        """Forget the callers that owe least, those who wait excepted."""
        idle = sorted((served, name) for name, served in self._served.items() if name not in self._waiting)
        for _, name in idle[: -MOST_REMEMBERED // 2]:
            del self._served[name]

    def _next(self) -> str:
        waiting = self._waiting
        return next(iter(waiting)) if len(waiting) == 1 else min(waiting, key=self._served.__getitem__)

    def first(self) -> Item | None:
        """The item whose turn it is; None if none waits."""
        return self._waiting[self._next()][0] if self._waiting else None

    def pop(self) -> Item:
        """Remove the item whose turn it is, and return it.

        Raises:
            KeyError: none waits.
        """
        if not self._waiting:
            raise KeyError("nothing waits")
        caller = self._next()
        queue = self._waiting[caller]
        item = queue.popleft()
        self._count -= 1
        if not queue:
            del self._waiting[caller]
        self._level = max(self._level, self._served[caller])
        return item

    def pass_by(self, caller: str) -> None:
        """Note a turn of a caller that need not wait, as if it had waited and been next."""
        self._level = self._enter(caller)

    def charge(self, caller: str, milliseconds: float) -> None:
        """Count work that is, or will be, done for a caller; a correction may be negative."""
        self._served[caller] = self._served.get(caller, self._level) + milliseconds

    def clear(self) -> list[Item]:
        """Remove all items, and return them."""
        items = [*self]
        self._waiting.clear()
        self._count = 0
        return items


@dataclass(eq=False)
class Holding:
    """A part of a room.

    Args:
        give_way: asks the holder to leave the room to others; returns False where that is not possible any more.
        share: what the holder uses the room for, such as a map: of the shares of one caller, too, the largest gives
            way.
        caller: the holder.
    """

    give_way: Callable[[], bool]
    share: Hashable = None
    caller: str = field(default_factory=CALLER.get)
    size: int = 0


class SharedRoom:
    """A limited number of places, or of bytes, that callers share.  Not thread-safe.

    Who holds most gives way as long as it holds more than the other would.  Where it cannot give way, because its work
    has begun, the other is let in all the same: the room is then over its capacity by as much, for as long as that work
    takes.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity, self.held = capacity, 0
        self._holdings: dict[Holding, None] = {}  # in the order in which they came
        self._of_caller: Counter[str] = Counter()

    def has_room(self, size: int = 1, share: Hashable = None, caller: str | None = None) -> bool:
        """Whether a caller would be given this room now, if need be that of others; None: the present caller."""
        if self.held + size <= self.capacity:
            return True
        return bool(self._greediest(CALLER.get() if caller is None else caller, share, size))

    def take(self, holding: Holding, size: int = 1) -> bool:
        """Let a holding grow by ``size``; False if there is no room, and then nothing has changed."""
        given = None
        while self.held + size > self.capacity:
            greediest = self._greediest(holding.caller, holding.share, size)
            if not greediest and given is None:
                return False
            given = next((one for one in reversed(greediest) if one is not holding and one.give_way()), None)
            if given is None:
                break
            self.release(given)
        self._holdings[holding] = None
        self._add(holding, size)
        return True

    def release(self, holding: Holding, size: int | None = None) -> None:
        """Let a holding shrink, or leave if ``size`` is None; one that has given way has left already."""
        if holding not in self._holdings:
            return
        self._add(holding, -(holding.size if size is None else size))
        if size is None:
            del self._holdings[holding]

    def _add(self, holding: Holding, size: int) -> None:
        holding.size += size
        self.held += size
        self._of_caller[holding.caller] += size
        if not self._of_caller[holding.caller]:
            del self._of_caller[holding.caller]

    def _greediest(self, caller: str, share: Hashable, size: int) -> list[Holding]:
        """The holdings of which one has to give way, the oldest first; none if the caller itself holds most."""
        if not self._of_caller:
            return []
        name, most = max(self._of_caller.items(), key=lambda one: one[1])
        if most > self._of_caller[caller] + size:
            return self._largest_share(name)[0]
        holdings, most = self._largest_share(caller)
        own = sum(one.size for one in self._holdings if one.caller == caller and one.share == share)
        return holdings if most > own + size else []

    def _largest_share(self, caller: str) -> tuple[list[Holding], int]:
        """The holdings of a caller in its largest share, and their size."""
        sizes: Counter[Hashable] = Counter()
        for one in self._holdings:
            if one.caller == caller:
                sizes[one.share] += one.size
        if not sizes:
            return [], 0
        share, most = max(sizes.items(), key=lambda one: one[1])
        return [one for one in self._holdings if (one.caller, one.share) == (caller, share) and one.size], most


REFUSALS_A_SECOND = 50
"""Refusals of one caller that are answered at once in a second."""

REFUSAL_SECONDS = 2.0
"""How long each further one waits: about as long as its Retry-After asks the caller to wait."""


class RefusalPace:
    """The pace at which callers are told to come again: one that comes again at once would keep the service busy."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._began = clock, -math.inf
        self._refused: Counter[str] = Counter()

    def pause(self, caller: str) -> float:
        """Count a refusal: the seconds for which its answer has to wait."""
        now = self._clock()
        if now - self._began >= 1:
            self._began = now
            self._refused.clear()
        self._refused[caller] += 1
        return REFUSAL_SECONDS if self._refused[caller] > REFUSALS_A_SECOND else 0.0
