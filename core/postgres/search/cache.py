"""Rows that were read, up to a number of bytes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable, Mapping, Sequence

BYTES = 256 << 20
"""The size of the cache of a service, unless it is told another."""

_OVERHEAD = 200  # bytes of an entry beside its value


class RowCache:
    """Stored values by key; those that were not used for the longest time go first.  Any thread may use it.

    Args:
        most_bytes: of all values together.
    """

    def __init__(self, most_bytes: int = BYTES) -> None:
        self._most, self._size = most_bytes, 0
        self._lock = threading.Lock()
        self._values: OrderedDict[Hashable, bytes] = OrderedDict()
        self.hits = self.misses = 0

    def __len__(self) -> int:
        return len(self._values)

    @property
    def size(self) -> int:
        """The bytes that it takes."""
        return self._size

    def get(self, keys: Sequence[Hashable]) -> dict[Hashable, bytes]:
        """Those of some values that it has."""
        with self._lock:
            found = {key: value for key in keys if (value := self._values.get(key)) is not None}
            for key in found:
                self._values.move_to_end(key)
            self.hits += len(found)
            self.misses += len(keys) - len(found)
        return found

    def put(self, values: Mapping[Hashable, bytes]) -> None:
        """Keep values, and drop others for them."""
        with self._lock:
            for key, value in values.items():
                if (before := self._values.pop(key, None)) is not None:
                    self._size -= len(before) + _OVERHEAD
                self._values[key] = value
                self._size += len(value) + _OVERHEAD
            while self._size > self._most and self._values:
                _, gone = self._values.popitem(last=False)
                self._size -= len(gone) + _OVERHEAD
