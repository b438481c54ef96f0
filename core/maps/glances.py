"""The best keypoints of the places of a map, kept in memory for the choice of those that are compared as a whole."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from core.geometry.keypoints import LENGTH, Keypoints
from core.geometry.matching import GLANCED, glance_at

MOST = 8192
"""Places of a map whose glances are kept, 32 MiB; those that were not used for the longest time go first."""


class Glances:
    """Glances by row.  The keypoints of a row never change once it has any.  Any thread may use it.

    Args:
        keypoints_at: reads the keypoints of places by their rows; None for one that has none.
        most: places that are kept.
    """

    def __init__(self, keypoints_at: Callable[[Sequence[int]], list[Keypoints | None]], most: int = MOST) -> None:
        self._keypoints_at, self._most = keypoints_at, most
        self._lock = threading.Lock()
        self._kept: OrderedDict[int, NDArray[np.int8]] = OrderedDict()

    def at(self, rows: Sequence[int]) -> NDArray[np.int8]:
        """The glances at the places of some rows, int8 [n, GLANCED, 64]; zeros where there are no keypoints."""
        with self._lock:
            known = {row: kept for row in rows if (kept := self._kept.get(row)) is not None}
            for row in known:
                self._kept.move_to_end(row)
        missing = [row for row in rows if row not in known]
        if missing:
            found = zip(missing, self._keypoints_at(missing), strict=True)
            read = {row: glance_at(keypoints) for row, keypoints in found if keypoints is not None}
            self._keep(read)
            known |= read
        glances = np.zeros((len(rows), GLANCED, LENGTH), np.int8)
        for at, row in enumerate(rows):
            if row in known:
                glances[at] = known[row]
        return glances

    def _keep(self, read: dict[int, NDArray[np.int8]]) -> None:
        with self._lock:
            self._kept |= read
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
