"""The index files of a map, which are made again if they are missing, stale or damaged.

codes-….index       codes of a group of segments, and the rows and checksums that SQLite has of them
recall.index        the recall that was measured
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from core.index import Coder, Codes
from core.maps.status import Recall
from core.storage.database.segments import SegmentEntry
from core.storage.files.array_files import StaleArrays, check_arrays, read_arrays, write_arrays
from core.storage.files.segment_files import Layout

GROUP_ROWS = 4096
"""About the number of rows that have their codes in one file: some 9 MB with the default encoder."""


def segments_per_group(layout: Layout) -> int:
    """How many segments have their codes in one file."""
    return max(1, GROUP_ROWS // layout.rows_per_segment)


def codes_name(group: int) -> str:
    """File name of the codes of group ``group``, counted from 0."""
    return f"codes-{group + 1:06d}.index"


class IndexFiles:
    """The index files of one map.  Reading raises StaleArrays if a file is of no use; a failed write is only logged."""

    def __init__(self, folder: Path, layout: Layout) -> None:
        """For the map in ``folder``."""
        self._folder = folder
        self._map = f"{layout.identity} {layout.dimension} {layout.precision}"
        self.group_size = segments_per_group(layout)
        """How many segments have their codes in one file."""
        self.coder = Coder.of(layout.dimension)
        """The encoder of the codes."""

    @property
    def _made_by(self) -> str:
        return f"{self._map} {self.coder.digest}"

    def group_entries(self, entries: Sequence[SegmentEntry], group: int) -> Sequence[SegmentEntry]:
        """The segments of a group; empty after the last group."""
        return entries[group * self.group_size : (group + 1) * self.group_size]

    def _group_of(self, entries: Sequence[SegmentEntry]) -> str:
        listed = json.dumps([[segment.number, segment.rows, segment.checksum] for segment in entries])
        return f"{self._made_by} {hashlib.sha256(listed.encode()).hexdigest()}"

    def read_codes(self, entries: Sequence[SegmentEntry]) -> Codes:
        """Read the codes of the rows of a group, whose segments are ``entries``."""
        path = self._folder / codes_name(entries[0].number // self.group_size)
        codes = read_arrays(path, "codes", self._group_of(entries)).get("codes", self.coder.blank(0))
        wanted = (sum(segment.rows for segment in entries), self.coder.bytes_per_place)
        if codes.shape != wanted or codes.dtype != np.uint8:
            raise StaleArrays("it holds other codes than expected")
        return codes

    def write_codes(self, entries: Sequence[SegmentEntry], codes: Codes) -> bool:
        """Write the codes of a group; returns whether they were written."""
        path = self._folder / codes_name(entries[0].number // self.group_size)
        return write_arrays(path, "codes", self._group_of(entries), {"codes": codes})

    def remove_codes(self, group: int) -> None:
        """Delete the file of the codes of a group, if there is one.

        Raises:
            OSError: the disk refuses.
        """
        (self._folder / codes_name(group)).unlink(missing_ok=True)

    def read_recall(self) -> Recall:
        """Read the last recall that was measured."""
        arrays = read_arrays(self._folder / "recall.index", "recall", self._made_by)
        try:
            at_1, queries, shortlist, places = arrays["recall"].tolist()
            return Recall(at_1=at_1, queries=int(queries), shortlist=int(shortlist), places=int(places))
        except (KeyError, ValueError) as error:
            raise StaleArrays("it holds no recall") from error

    def write_recall(self, recall: Recall) -> bool:
        """Write the recall; returns whether it was written."""
        values = np.array([recall.at_1, recall.queries, recall.shortlist, recall.places])
        return write_arrays(self._folder / "recall.index", "recall", self._made_by, {"recall": values})

    def check(self, entries: Sequence[SegmentEntry]) -> tuple[int, list[str]]:
        """Read the codes of all groups that are full; returns the bytes checked, and which files are stale."""
        checked, stale = 0, list[str]()
        full = [self.group_entries(entries, group) for group in range(len(entries) // self.group_size)]
        for group in full:
            if group[-1].rows < group[0].rows:
                continue  # the group still grows
            path = self._folder / codes_name(group[0].number // self.group_size)
            try:
                checked += check_arrays(path, "codes", self._group_of(group))
            except StaleArrays as error:
                stale.append(f"{path.name}: {error}")
        return checked, stale

    def remove(self) -> None:
        """Delete all index files, because the map is searched exactly.

        Raises:
            OSError: the disk refuses.
        """
        for path in self._folder.glob("*.index"):
            path.unlink(missing_ok=True)
