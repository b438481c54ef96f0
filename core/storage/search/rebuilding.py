"""Codes and lists of a map made anew from its descriptors, beside those that are searched meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from core.index import Coder, Codes, CodeTable, InvertedLists
from core.storage.search.snapshot import Snapshot

SAMPLE = 2000
"""Places from which it is learnt what all codes have in common."""

_ROWS_AT_ONCE = 256


def fitted_coder(snapshot: Snapshot) -> Coder:
    """What codes of a map's places have in common, from a sample of them."""
    living = np.flatnonzero(snapshot.alive)
    chosen = np.sort(np.random.default_rng(0).permutation(living)[:SAMPLE])
    return Coder.fitted(snapshot.descriptors_at(chosen))


@dataclass
class Remade:
    """What a map is to be searched by; ``lists`` where it is to have any."""

    table: CodeTable
    lists: InvertedLists | None

    def put_into(self, newest: Snapshot) -> Snapshot:
        """The newest snapshot, searched by this; rows that have come since get their codes now."""
        if newest.table is None:
            return newest  # meanwhile its owner wants it to be searched exactly
        self.table = _extended(self.table, newest, newest.rows)
        return replace(newest, table=self.table, lists=self.lists)


def remade(newest: Callable[[], Snapshot], with_lists: bool, progress: Callable[[int, int], None]) -> Remade:
    """All of it, from the descriptors.  Takes as much memory again as what is there.

    Args:
        newest: gives the newest snapshot.
        progress: told of rows done and of all; what it raises stops it.
    """
    snapshot = newest()
    progress(0, snapshot.rows)
    table = _caught_up(CodeTable.empty(fitted_coder(snapshot)), newest, progress)
    lists = InvertedLists.built(table, progress=progress) if with_lists and len(table) else None
    # Lists take long, and what came meanwhile would hold up all writes if it were encoded when this is published.
    return Remade(_caught_up(table, newest, progress), lists)


def _caught_up(table: CodeTable, newest: Callable[[], Snapshot], progress: Callable[[int, int], None]) -> CodeTable:
    """With the codes of all rows that there are by now."""
    while len(table) < (snapshot := newest()).rows:
        table = _extended(table, snapshot, min(snapshot.rows, len(table) + _ROWS_AT_ONCE))
        progress(len(table), snapshot.rows)
    return table


def _extended(table: CodeTable, snapshot: Snapshot, stop: int) -> CodeTable:
    """With the codes of the rows up to ``stop``."""
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
