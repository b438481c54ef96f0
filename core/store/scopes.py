"""The rows of a map that a query may find, from its caller's knowledge of the place."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from core.judgement.priors import Constraint, Flags, InSequences, NotLately, Values, holding, log_weights
from core.ledger.maps import places, sequences
from core.ledger.maps.connection import MapConnection
from core.maps.place_filter import Scalar
from core.maps.selection import Conditions, Selection
from core.places import pose_kinds
from core.store.snapshot import Scope, Snapshot


class Chooser:
    """Chooses the rows of one map at one moment; only metadata and sequences are read.

    Args:
        connection: in the transaction of the snapshot.
    """

    def __init__(self, snapshot: Snapshot, connection: MapConnection) -> None:
        self._snapshot, self._connection = snapshot, connection

    def scope(self, selection: Selection) -> Scope:
        """Which rows may be found, and their weights.

        Raises:
            MixedCoordinates: an area is given in coordinates that the places do not have.
            StorageFailure: the metadata cannot be read.
        """
        snapshot = self._snapshot
        selection.check_coordinates(lambda _kind: pose_kinds(snapshot.whereabouts.kind[snapshot.alive]))
        return Scope(self._snapshot, self._allowed(selection), self._weights(selection))

    def _constraints(self, conditions: Conditions) -> list[Constraint]:
        """The conditions on pose, time and sequence as constraints on rows."""
        found = list(conditions.geometry)
        if conditions.sequences is not None:
            codes = sequences.codes_of(self._connection, conditions.sequences)
            found.insert(0, InSequences(tuple(codes.values())))
        return found

    def _allowed(self, selection: Selection) -> Flags | None:
        filters, snapshot = selection.filters, self._snapshot
        if not (filters or selection.recent or selection.excluded):
            return None
        constraints = self._constraints(filters)
        if (not_recent := self._not_recent(selection)) is not None:
            constraints.append(not_recent)
        allowed = holding(constraints, snapshot.whereabouts)
        if filters.metadata:
            # The constraints, which are in memory, come first: fewer rows are then looked up.
            rows = self._rows_with(filters.metadata, np.flatnonzero(allowed) if constraints else None)
            among, allowed = allowed, np.zeros(snapshot.rows, np.bool_)
            allowed[rows] = among[rows]
        if selection.excluded is not None:
            rows = np.array(places.all_rows_of(self._connection, selection.excluded), np.int64)
            allowed[rows[rows < len(allowed)]] = False
        return allowed

    def _not_recent(self, selection: Selection) -> NotLately | None:
        recent = selection.recent
        if recent is None:
            return None
        code = sequences.find_code(self._connection, recent.sequence)
        if code is None:
            return None  # the map has no place of the sequence yet
        oldest = sequences.oldest_of_last(self._connection, code, recent.frames) if recent.frames else None
        moment = recent.moment if recent.seconds else None
        return NotLately(code, oldest, moment, round(1e6 * recent.seconds))

    def _weights(self, selection: Selection) -> Values | None:
        prior, snapshot = selection.prior, self._snapshot
        if not prior:
            return None
        fits = [constraint.fit(snapshot.whereabouts) for constraint in self._constraints(prior)]
        if prior.metadata:
            fit = np.zeros(snapshot.rows)
            fit[self._rows_with(prior.metadata)] = 1
            fits.append(fit)
        return log_weights(fits, selection.trust)

    def _rows_with(self, metadata: Mapping[str, Scalar], among: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """The rows of the snapshot whose metadata has these values; places that were stored later are left out."""
        rows = places.rows_with(self._connection, metadata, among)
        return rows[rows < self._snapshot.rows]
