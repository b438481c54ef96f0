"""Where places are: one spot each, or columns of many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

from core.places import NO_TIME, Whereabouts


@dataclass(frozen=True)
class Spot:
    """Where one place is; the fields are those of :class:`Whereabouts`."""

    kind: int
    position: tuple[float, float, float]
    sequence: int
    ordinal: int
    heading: float = nan
    timestamp: int = NO_TIME


def whereabouts_of(spots: Sequence[Spot]) -> Whereabouts:
    """Of n places, row-aligned."""
    return Whereabouts(
        np.array([spot.kind for spot in spots], dtype=np.int8),
        np.array([spot.position for spot in spots], dtype=np.float64).reshape(-1, 3),
        np.array([spot.sequence for spot in spots], dtype=np.int32),
        np.array([spot.ordinal for spot in spots], dtype=np.int64),
        np.array([spot.heading for spot in spots], dtype=np.float32),
        np.array([spot.timestamp for spot in spots], dtype=np.int64),
    )


def joined(parts: Sequence[Whereabouts]) -> Whereabouts:
    """One after the other."""
    if not parts:
        return whereabouts_of([])
    return Whereabouts(
        np.concatenate([part.kind for part in parts]),
        np.concatenate([part.position for part in parts]),
        np.concatenate([part.sequence for part in parts]),
        np.concatenate([part.ordinal for part in parts]),
        np.concatenate([part.heading for part in parts]),
        np.concatenate([part.timestamp for part in parts]),
    )


def memory_of(whereabouts: Whereabouts) -> int:
    """Bytes of its columns."""
    columns = vars(whereabouts).values()
    return sum(column.nbytes for column in columns)
