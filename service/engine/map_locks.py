"""A lock for each map, held during a write that depends on what was read before."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class _Lock:
    lock: threading.RLock = field(default_factory=threading.RLock)
    users: int = 0


class MapLocks:
    """One reentrant lock for each map, which exists only while a thread holds it or waits for it.  Thread-safe."""

    def __init__(self) -> None:
        self._locks: dict[str, _Lock] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._locks)

    @contextmanager
    def of(self, map_id: str) -> Iterator[None]:
        """Hold the lock of a map; blocks.  A thread that holds it already may take it again."""
        with self._lock:
            lock = self._locks.setdefault(map_id, _Lock())
            lock.users += 1
        try:
            with lock.lock:
                yield
        finally:
            with self._lock:
                lock.users -= 1
                if not lock.users:
                    del self._locks[map_id]
