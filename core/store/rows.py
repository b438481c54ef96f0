"""Descriptors and local descriptors by row, from a bounded cache or from the database."""

from __future__ import annotations

import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.errors import UnknownPlace
from core.ledger.maps import rows as stored_rows
from core.ledger.maps.connection import MapConnection
from core.maps.forms import Form

BYTES = 256 << 20
"""The size of the cache of a service, unless another is given."""

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

    def read(
        self, of: tuple[Hashable, ...], rows: Sequence[int], missing: Callable[[list[int]], Mapping[int, bytes]]
    ) -> dict[int, bytes]:
        """Values by row, from the cache or else read; rows that have none are left out.

        Args:
            of: the part of the keys before the row, which names what is read.
            missing: reads the values of rows that the cache lacks.
        """
        keys = {row: (*of, row) for row in rows}
        cached = self.get(list(keys.values()))
        found = {row: cached[key] for row, key in keys.items() if key in cached}
        if lacking := [row for row in keys if row not in found]:
            read = missing(lacking)
            self.put({keys[row]: value for row, value in read.items()})
            found |= read
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


class Rows:
    """Reads rows of one map.  Any thread may use it.

    A row belongs to the same frame for ever, so what was read stays right; unless the database is restored to an
    earlier moment, and then another object of this class takes its place, which shares nothing with it in the cache.

    part_rows: rows that one thread reads and compares.

    Args:
        glancing: begins to read the map by single statements.
        form: of its descriptors.
        cache: of all maps.
    """

    part_rows = 32

    def __init__(
        self, glancing: Callable[[], AbstractContextManager[MapConnection]], form: Form, cache: RowCache
    ) -> None:
        self._glancing, self._form, self._cache = glancing, form, cache
        self.generation = secrets.token_hex(8)

    def descriptors(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """The descriptors of rows: float32 [k, D]."""
        return self._form.descriptors(self._stored("descriptors", rows))

    def inner_products(self, queries: NDArray[np.float32], rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Inner products of queries, float32 [B, D], with the descriptors of rows: float32 [B, k]."""
        return self._form.inner_products(queries, self._stored("descriptors", rows))

    def locals(self, rows: NDArray[np.int64]) -> NDArray[np.int8]:
        """The local descriptors of rows: int8 [k, C, L]."""
        if not any(self._form.local_shape):
            return np.empty((len(rows), *self._form.local_shape), np.int8)
        return self._form.locals(self._stored("locals", rows))

    def _stored(self, kind: Literal["descriptors", "locals"], rows: NDArray[np.int64]) -> list[bytes]:
        """The stored form of rows.

        Raises:
            UnknownPlace: the place of a row was deleted a while ago.
        """
        wanted = [int(row) for row in rows]

        def read(missing: list[int]) -> dict[int, bytes]:
            with self._glancing() as connection:
                return stored_rows.at(connection, kind, missing)

        found = self._cache.read((self.generation, kind), wanted, read)
        try:
            return [found[row] for row in wanted]
        except KeyError:
            raise UnknownPlace("A place was deleted while it was read.") from None
