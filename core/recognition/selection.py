"""What a caller knows of a place (filters and priors), and the rows of a map that a search may therefore find."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from core.judgement.priors import Constraint, Flags, InSequences, NotLately, Values, holding, log_weights
from core.storage import Map, Snapshot
from core.storage.attributes import Scalar

TRUST = 0.9
"""The probability that a prior is right, if the caller states none."""


@dataclass(frozen=True)
class RecentFrames:
    """The robot's own last frames, which a query leaves out.

    sequence: the sequence to which the robot adds its frames.
    frames: so many of the last places of the sequence are left out.
    moment: the time of the query, microseconds since 1970 UTC.
    seconds: places of the sequence less than so many seconds from ``moment`` are left out.
    """

    sequence: str
    frames: int = 0
    moment: int | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class Conditions:
    """Conditions on a place; all of them have to hold.

    geometry: conditions on pose and time.
    sequences: the place belongs to one of these; None: to any.
    metadata: the place's metadata has these values.
    """

    geometry: tuple[Constraint, ...] = ()
    sequences: tuple[str, ...] | None = None
    metadata: Mapping[str, Scalar] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.geometry or self.sequences is not None or self.metadata)

    def constraints(self, map_: Map) -> list[Constraint]:
        """The conditions on pose, time and sequence as constraints on the rows of a map."""
        found = list(self.geometry)
        if self.sequences is not None:
            found.insert(0, InSequences(tuple(map_.attributes.sequence_codes(self.sequences).values())))
        return found


@dataclass(frozen=True)
class SearchScope:
    """Which rows of a snapshot a search may find, and their prior weights.

    allowed: bool [rows]; None: all rows.
    weights: float64 [rows], at most 0, the log prior that is added to the log odds of a place; None: no prior.
    """

    allowed: Flags | None = None
    weights: Values | None = None

    @property
    def favoured(self) -> Flags | None:
        """The allowed rows that the prior favours, whose weight is nearer to 0 than to the lowest; None if no prior."""
        if self.weights is None:
            return None
        favoured = self.weights >= self.weights.min() / 2
        return favoured if self.allowed is None else favoured & self.allowed


WHOLE_MAP = SearchScope()


@dataclass(frozen=True)
class Selection:
    """What is known of the place that a query shows.

    filters: conditions that have to hold; other places are not searched.
    prior: conditions that hold with the probability ``trust``; other places lose odds.
    recent: the robot's own last frames, which are left out.
    excluded: the id of a place that is left out.
    """

    filters: Conditions = Conditions()
    prior: Conditions = Conditions()
    trust: float = TRUST
    recent: RecentFrames | None = None
    excluded: str | None = None

    def __bool__(self) -> bool:
        return bool(self.filters or self.prior or self.recent or self.excluded)

    def scope(self, map_: Map, snapshot: Snapshot) -> SearchScope:
        """Which rows of a snapshot of the map may be found, and their weights; only metadata is read from disk.

        Raises:
            StorageFailure: the metadata cannot be read.
        """
        return SearchScope(self._allowed(map_, snapshot), self._weights(map_, snapshot))

    def _allowed(self, map_: Map, snapshot: Snapshot) -> Flags | None:
        if not (self.filters or self.recent or self.excluded):
            return None
        constraints = self.filters.constraints(map_)
        if (not_recent := self._not_recent(map_)) is not None:
            constraints.append(not_recent)
        allowed = holding(constraints, snapshot.whereabouts)
        if self.filters.metadata:
            # The constraints, which are in memory, come first: fewer rows are then looked up on disk.
            rows = _rows_with(map_, snapshot, self.filters.metadata, np.flatnonzero(allowed) if constraints else None)
            among, allowed = allowed, np.zeros(snapshot.rows, np.bool_)
            allowed[rows] = among[rows]
        if self.excluded is not None:
            (row,) = map_.rows_of([self.excluded])
            if row is not None and row < len(allowed):
                allowed[row] = False
        return allowed

    def _not_recent(self, map_: Map) -> NotLately | None:
        if self.recent is None:
            return None
        code = map_.attributes.sequence_codes([self.recent.sequence]).get(self.recent.sequence)
        if code is None:
            return None  # the map has no place of the sequence yet
        oldest = map_.attributes.oldest_of_last(code, self.recent.frames) if self.recent.frames else None
        moment = self.recent.moment if self.recent.seconds else None
        return NotLately(code, oldest, moment, round(1e6 * self.recent.seconds))

    def _weights(self, map_: Map, snapshot: Snapshot) -> Values | None:
        if not self.prior:
            return None
        fits = [constraint.fit(snapshot.whereabouts) for constraint in self.prior.constraints(map_)]
        if self.prior.metadata:
            fit = np.zeros(snapshot.rows)
            fit[_rows_with(map_, snapshot, self.prior.metadata)] = 1
            fits.append(fit)
        return log_weights(fits, self.trust)


def _rows_with(
    map_: Map, snapshot: Snapshot, metadata: Mapping[str, Scalar], among: NDArray[np.int64] | None = None
) -> NDArray[np.int64]:
    """The rows of the snapshot whose metadata has these values; places that were stored later are left out."""
    rows = map_.attributes.rows_with(metadata, among)
    return rows[rows < snapshot.rows]
