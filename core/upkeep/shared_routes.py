"""Traverses that seem to follow one route although nothing says so: their frames are no rivals, but await alignment."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.judgement.alignment import LEAST_FRAMES
from core.places import NO_POSE, NO_SEQUENCE, Whereabouts
from core.upkeep.hubness import Alias

LEAST_SHARE = 1 / 3
"""At least this share of the frames of one of the traverses look like frames of the other."""

IN_ORDER = 0.7
"""The rank correlation of the frames' positions, from which on they come in the same order; by chance it is near 0."""


@dataclass(frozen=True)
class SharedRoute:
    """Two traverses that seem to follow one route.

    sequences: the codes of the two.
    aliases: the frames of either that look more like one of the other than like their own neighbours.
    """

    sequences: tuple[int, int]
    aliases: list[Alias]


def shared_routes(where: Whereabouts, aliases: Iterable[Alias], examined: NDArray[np.int64]) -> list[SharedRoute]:
    """Find traverses whose frames look alike one after the other in the same order; those of most frames come first.

    Frames that poses of one kind put at different places only look alike, so they do not count.

    Args:
        where: of all places.
        examined: int64 [k], the positions of those among which the aliases were found.
    """
    looked_at = where.sequence[examined]
    found: dict[tuple[int, int], list[Alias]] = {}
    for alias in aliases:
        first, second = sorted((int(where.sequence[alias.place]), int(where.sequence[alias.other])))
        known = where.kind[alias.place] == where.kind[alias.other] != NO_POSE
        if NO_SEQUENCE != first != second and not known:
            found.setdefault((first, second), []).append(alias)
    routes = [SharedRoute(pair, some) for pair, some in found.items() if _is_one_route(where, pair, some, looked_at)]
    return sorted(routes, key=lambda route: -len(route.aliases))


def _is_one_route(
    where: Whereabouts, pair: tuple[int, int], aliases: list[Alias], looked_at: NDArray[np.int32]
) -> bool:
    places = np.array([alias.place for alias in aliases])
    others = np.array([alias.other for alias in aliases])
    shares = [(where.sequence[places] == code).sum() / max(1, (looked_at == code).sum()) for code in pair]
    if len(aliases) < LEAST_FRAMES or max(shares) < LEAST_SHARE:
        return False
    turned = where.sequence[places] == pair[1]
    first, second = np.where(turned, others, places), np.where(turned, places, others)
    return _rank_correlation(where.ordinal[first], where.ordinal[second]) >= IN_ORDER


def _rank_correlation(values: NDArray[np.int64], others: NDArray[np.int64]) -> float:
    """Spearman's coefficient of n pairs; equal values are ranked as they come, 0 if all are equal."""
    if len(np.unique(values)) < 2 or len(np.unique(others)) < 2:
        return 0.0
    first, second = (np.argsort(np.argsort(some, kind="stable")).astype(np.float64) for some in (values, others))
    return float(np.corrcoef(first, second)[0, 1])
