"""Computing the codes of rows, and rebuilding all codes of a map while the present ones are searched."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from core.index import Coder, Codes, CodeTable
from core.storage.search.snapshot import Snapshot

_ROWS_AT_ONCE = 256


def rebuilt(newest: Callable[[], Snapshot], progress: Callable[[int, int], None]) -> CodeTable:
    """Codes of all rows, made from the descriptors; they take as much memory again as the present ones.

    Args:
        newest: returns the newest snapshot.
        progress: called with the number of rows done and of all; its exceptions end the work.
    """
    snapshot = newest()
    progress(0, snapshot.rows)
    table = CodeTable.empty(Coder.of(snapshot.dimension))
    while len(table) < (snapshot := newest()).rows:
        table = extended(table, snapshot, min(snapshot.rows, len(table) + _ROWS_AT_ONCE))
        progress(len(table), snapshot.rows)
    return table


def extended(table: CodeTable, snapshot: Snapshot, stop: int) -> CodeTable:
    """The table with the codes of the rows up to ``stop``."""
    while (start := len(table)) < stop:
        number = start // snapshot.rows_per_segment
        end = min(stop, (number + 1) * snapshot.rows_per_segment)
        table = table.appended(codes_of(table.coder, snapshot, start, end))
    return table


def codes_of(coder: Coder, snapshot: Snapshot, start: int, stop: int) -> Codes:
    """The codes of rows of one segment."""
    if snapshot.segments[start // snapshot.rows_per_segment].removed:
        return coder.blank(stop - start)
    return coder.encode(snapshot.descriptors_at(np.arange(start, stop)))
