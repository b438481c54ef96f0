"""From what a caller knows to the rows of a map that a search may choose from, and how they weigh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from core.judgement.priors import Constraint, Flags, InSequences, NotLately, Values, holding, log_weights
from core.storage import Map, Snapshot
from core.storage.attributes import Scalar

TRUST = 0.9
"""Of a soft prior whose caller names none."""


@dataclass(frozen=True)
class Recent:
    """The robot's own last frames, which are not to be found again: of ``sequence`` the last ``frames`` places, and
    those less than ``seconds`` from ``moment`` (microseconds since 1970 UTC)."""

    sequence: str
    frames: int = 0
    moment: int | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class Knowledge:
    """Things that are true of the place asked for; all of them."""

    geometry: tuple[Constraint, ...] = ()
    sequences: tuple[str, ...] | None = None
    metadata: Mapping[str, Scalar] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.geometry or self.sequences is not None or self.metadata)

    def constraints(self, map_: Map) -> list[Constraint]:
        """All but the metadata, as they stand in this map."""
        found = list(self.geometry)
        if self.sequences is not None:
            found.insert(0, InSequences(tuple(map_.attributes.sequence_codes(self.sequences).values())))
        return found


@dataclass(frozen=True)
class Choice:
    """What of a snapshot may be found.

    allowed: bool [rows]; None: everything.
    weights: float64 [rows], at most 0, to be added to the log odds of a place; None: nothing.
    """

    allowed: Flags | None = None
    weights: Values | None = None

    @property
    def favoured(self) -> Flags | None:
        """Of what is allowed the rows whose weight is more than half lost; None without weights."""
        if self.weights is None:
            return None
        favoured = self.weights >= self.weights.min() / 2
        return favoured if self.allowed is None else favoured & self.allowed


EVERYTHING = Choice()


@dataclass(frozen=True)
class Selection:
    """What a query is to choose from.

    filters: what must be true of a place; places of which it is not are not read.
    prior: what is true with the probability ``trust``.
    recent: the caller's own last frames, left out.
    without: the id of a place that is left out.
    """

    filters: Knowledge = Knowledge()
    prior: Knowledge = Knowledge()
    trust: float = TRUST
    recent: Recent | None = None
    without: str | None = None

    def __bool__(self) -> bool:
        return bool(self.filters or self.prior or self.recent or self.without)

    def choice(self, map_: Map, snapshot: Snapshot) -> Choice:
        """What of a snapshot of the map may be found; the map is not read from disk for what is in memory.

        Raises:
            StorageFailure: its metadata cannot be read.
        """
        return Choice(self._allowed(map_, snapshot), self._weights(map_, snapshot))

    def _allowed(self, map_: Map, snapshot: Snapshot) -> Flags | None:
        if not (self.filters or self.recent or self.without):
            return None
        constraints = self.filters.constraints(map_)
        if (lately := self._lately(map_)) is not None:
            constraints.append(lately)
        allowed = holding(constraints, snapshot.whereabouts)
        if self.filters.metadata:
            # What is in memory first: it leaves the fewer rows to be looked up on disk.
            rows = _rows_with(map_, snapshot, self.filters.metadata, np.flatnonzero(allowed) if constraints else None)
            among, allowed = allowed, np.zeros(snapshot.rows, np.bool_)
            allowed[rows] = among[rows]
        if self.without is not None:
            (row,) = map_.rows_of([self.without])
            if row is not None and row < len(allowed):
                allowed[row] = False
        return allowed

    def _lately(self, map_: Map) -> NotLately | None:
        if self.recent is None:
            return None
        code = map_.attributes.sequence_codes([self.recent.sequence]).get(self.recent.sequence)
        if code is None:
            return None  # it is the first frame of its sequence
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
    """Rows of the snapshot; those of places written since are left out."""
    rows = map_.attributes.rows_with(metadata, among)
    return rows[rows < snapshot.rows]
