"""Maps made for the tests of the belief: places in a row, with and without poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.belief import Evidence, PlaceGraph, place_graph
from core.places import METRIC, NO_POSE, Neighborhood, Whereabouts

NEIGHBORHOOD = Neighborhood(radius=1.0, frames=1)


def walk(*lengths: int) -> Whereabouts:
    """Sequences of so many frames, without poses."""
    count = sum(lengths)
    sequence = np.repeat(np.arange(len(lengths)), lengths).astype(np.int32)
    ordinal = np.concatenate([np.arange(length) for length in lengths]) if lengths else np.empty(0)
    return Whereabouts(np.full(count, NO_POSE, np.int8), np.zeros((count, 3)), sequence, ordinal.astype(np.int64))


def posed(*paths: Sequence[tuple[float, float]]) -> Whereabouts:
    """Sequences through points of the plane, metres; headings are left to be told by the way."""
    plain = walk(*map(len, paths))
    points = np.array([[x, y, 0.0] for path in paths for x, y in path])
    return Whereabouts(np.full(len(points), METRIC, np.int8), points, plain.sequence, plain.ordinal)


def graph_of(where: Whereabouts, neighborhood: Neighborhood = NEIGHBORHOOD) -> PlaceGraph:
    """All of them living."""
    return place_graph(where, np.arange(len(where)), len(where), neighborhood)


def shows(*rows: int, gain: float = 3.0, unknown: float = 0.5) -> Evidence:
    """A frame that speaks for these rows alike."""
    return Evidence(np.array(rows, np.int64), np.full(len(rows), gain, np.float32), unknown)
