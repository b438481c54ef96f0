"""Possession of a map by one thread, for a write that depends on a look at it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class _Claim:
    lock: threading.RLock = field(default_factory=threading.RLock)
    claimed: int = 0


class Possession:
    """One lock a map, there only while somebody has it or waits for it.  From any thread."""

    def __init__(self) -> None:
        self._claims: dict[str, _Claim] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._claims)

    @contextmanager
    def of(self, map_id: str) -> Iterator[None]:
        """Have a map; blocks.  Whoever has it may take it again."""
        with self._lock:
            claim = self._claims.setdefault(map_id, _Claim())
            claim.claimed += 1
        try:
            with claim.lock:
                yield
        finally:
            with self._lock:
                claim.claimed -= 1
                if not claim.claimed:
                    del self._claims[map_id]
