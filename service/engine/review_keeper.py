"""Stores frames for review beside the requests: a thread writes them, and drops those for which there is no time.

People's verdicts on frames are written one after the other.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import deque
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from datetime import datetime
from typing import Any
from weakref import WeakValueDictionary

from core.errors import PlacerecError
from core.store import Map

MOST_WAITING, MOST_WAITING_BYTES = 32, 64 << 20
"""The most frames, and bytes of their files, that wait to be written; further ones are dropped."""

log = logging.getLogger("placerec.review")


class ReviewKeeper:
    """Writes frames to the maps that store them.  Any thread may offer one, and never waits.

    dropped: how many frames were to be stored and were not.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: deque[tuple[Map, bytes, Mapping[str, Any]]] = deque()
        self._bytes = 0
        self._closed = False
        self._thread: threading.Thread | None = None
        self.dropped = 0
        self._turns: WeakValueDictionary[tuple[str, datetime, int], asyncio.Lock] = WeakValueDictionary()

    @asynccontextmanager
    async def turn(self, map_: Map, number: int) -> AsyncIterator[None]:
        """Hold the turn to write a verdict on a stored frame of a map; call it on the event loop."""
        key = (map_.record.id, map_.record.created_at, number)
        async with self._turns.setdefault(key, asyncio.Lock()):
            yield

    def offer(self, map_: Map, data: bytes, answer: Mapping[str, Any]) -> None:
        """Have a frame stored, if the map's setting still says so when its turn comes.

        Args:
            data: the bytes of the frame's file.
            answer: how the map answered it; JSON values.
        """
        with self._changed:
            full = len(self._waiting) >= MOST_WAITING or self._bytes + len(data) > MOST_WAITING_BYTES
            if self._closed or full:
                self.dropped += 1
                return
            self._waiting.append((map_, data, answer))
            self._bytes += len(data)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="review", daemon=True)
                self._thread.start()
            self._changed.notify()

    def close(self) -> None:
        """Write the waiting frames, and stop; blocks."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._closed:
                    self._changed.wait()
                if not self._waiting:
                    return
                map_, data, answer = self._waiting.popleft()
                self._bytes -= len(data)
            try:
                if (setting := map_.record.review) is not None:
                    map_.review.keep(data, answer, setting)
            except PlacerecError as error:
                self.dropped += 1
                log.warning("a frame is not stored for review: %s", error, extra={"map": map_.record.id})
            except Exception:  # a defect, which must not end the thread
                self.dropped += 1
                log.exception("a frame is not stored for review")
