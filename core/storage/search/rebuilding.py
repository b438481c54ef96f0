"""Computing the codes of rows, and rebuilding all codes and lists of a map while the present ones are searched."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from core.index import Coder, Codes, CodeTable, InvertedLists
from core.storage.search.snapshot import Snapshot

SAMPLE = 2000
"""Places from which the coder of a map is fitted."""

_ROWS_AT_ONCE = 256


def fitted_coder(snapshot: Snapshot) -> Coder:
    """A coder, fitted to a sample of the map's places."""
    living = np.flatnonzero(snapshot.alive)
    chosen = np.sort(np.random.default_rng(0).permutation(living)[:SAMPLE])
    return Coder.fitted(snapshot.descriptors_at(chosen))


@dataclass
class RebuiltIndex:
    """The codes and lists that shall replace those of a map; ``lists`` is None in the tier compact."""

    table: CodeTable
    lists: InvertedLists | None

    def put_into(self, newest: Snapshot) -> Snapshot:
        """The newest snapshot with these codes and lists; rows that were added since get their codes now."""
        if newest.table is None:
            return newest  # its owner has chosen exact search meanwhile
        self.table = _extended(self.table, newest, newest.rows)
        return replace(newest, table=self.table, lists=self.lists)


def rebuilt(newest: Callable[[], Snapshot], with_lists: bool, progress: Callable[[int, int], None]) -> RebuiltIndex:
    """Build codes and lists from the descriptors; they take as much memory again as the present ones.

    Args:
        newest: returns the newest snapshot.
        progress: is called with the rows done and all rows; what it raises ends the work.
    """
    snapshot = newest()
    progress(0, snapshot.rows)
    table = _caught_up(CodeTable.empty(fitted_coder(snapshot)), newest, progress)
    lists = InvertedLists.built(table, progress=progress) if with_lists and len(table) else None
    # Building lists takes long.  Rows added meanwhile are encoded now, because writes wait while this is published.
    return RebuiltIndex(_caught_up(table, newest, progress), lists)


def _caught_up(table: CodeTable, newest: Callable[[], Snapshot], progress: Callable[[int, int], None]) -> CodeTable:
    """The table with the codes of all present rows."""
    while len(table) < (snapshot := newest()).rows:
        table = _extended(table, snapshot, min(snapshot.rows, len(table) + _ROWS_AT_ONCE))
        progress(len(table), snapshot.rows)
    return table


def _extended(table: CodeTable, snapshot: Snapshot, stop: int) -> CodeTable:
    """The table with the codes of the rows up to ``stop``."""
    while (start := len(table)) < stop:
        number = start // snapshot.rows_per_segment
        end = min(stop, (number + 1) * snapshot.rows_per_segment)
        table = table.appended(codes_of(table.coder, snapshot, start, end))
    return table


def codes_of(coder: Coder, snapshot: Snapshot, start: int, stop: int) -> Codes:
    """The codes of rows of one segment."""
    if snapshot.segments[start // snapshot.rows_per_segment].removed:
        return coder.nothing(stop - start)
    return coder.encode(snapshot.descriptors_at(np.arange(start, stop)))
