"""Descriptors as PostgreSQL keeps them: in the map's precision, as a data directory does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.maps.records import MapRecord
from core.storage.files.row_formats import (
    inner_products,
    pack_descriptors,
    pack_local,
    resting_types,
    unpack_descriptors,
    unpack_local,
)


class Form:
    """The stored form of the descriptors of one map."""

    def __init__(self, record: MapRecord) -> None:
        self._dimension, self._shape, self._precision = record.dimension, record.local_shape, record.precision
        types = resting_types(record.precision, record.dimension, record.local_shape)
        self._descriptor, self._local = (np.dtype([("stored", *one)]) for one in types)

    @property
    def frame_bytes(self) -> int:
        """The length of both of one frame in bytes."""
        return self._descriptor.itemsize + self._local.itemsize

    def packed(self, descriptor: NDArray[np.float32], local: NDArray[np.int8]) -> tuple[bytes, bytes]:
        """The stored form of a descriptor, float32 [D], and of local descriptors, int8 [C, L]."""
        packed = pack_descriptors(descriptor[np.newaxis], self._precision)[0]
        return packed.tobytes(), pack_local(local[np.newaxis], self._precision)[0].tobytes()

    def divided(self, frame: bytes) -> tuple[bytes, bytes]:
        """Both parts of the bytes of one frame in an export file."""
        return frame[: self._descriptor.itemsize], frame[self._descriptor.itemsize :]

    def descriptors(self, stored: Sequence[bytes]) -> NDArray[np.float32]:
        """Descriptors, float32 [n, D], from their stored form."""
        rows = np.frombuffer(b"".join(stored), self._descriptor)["stored"]
        return unpack_descriptors(rows, self._precision, self._dimension)

    def inner_products(self, queries: NDArray[np.float32], stored: Sequence[bytes]) -> NDArray[np.float32]:
        """Inner products of queries, float32 [B, D], with descriptors in stored form: float32 [B, n]."""
        rows = np.frombuffer(b"".join(stored), self._descriptor)["stored"]
        return inner_products(queries, rows, self._precision)

    def locals(self, stored: Sequence[bytes]) -> NDArray[np.int8]:
        """Local descriptors, int8 [n, C, L], from their stored form."""
        if not self._local.itemsize:
            return np.empty((len(stored), *self._shape), np.int8)
        rows = np.frombuffer(b"".join(stored), self._local)["stored"]
        return unpack_local(rows, self._precision, self._shape)
