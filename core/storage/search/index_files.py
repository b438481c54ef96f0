"""The index files of a map, which are made again if they are missing, stale or damaged.

coder.index         the coder of all codes of the map, made when the map gets its first codes
codes-….index       codes of a group of segments, and the rows and checksums that SQLite has of them
lists.index         rows by nearest centre
recall.index        the recall that was measured
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from core.index import Coder, Codes, InvertedLists
from core.storage.database.ledger import SegmentEntry
from core.storage.files.arrays import Arrays, StaleArrays, check_arrays, read_arrays, write_arrays
from core.storage.files.segment_files import Layout
from core.storage.search.tiers import Recall, Tier

GROUP_ROWS = 4096
"""About so many rows have their codes in one file: some 9 MB with the default encoder."""

_CENTRED, _LISTED = "centred", "listed"


def segments_per_group(layout: Layout) -> int:
    """How many segments have their codes in one file."""
    return max(1, GROUP_ROWS // layout.rows_per_segment)


def codes_name(group: int) -> str:
    """File name of the codes of group ``group``, counted from 0."""
    return f"codes-{group + 1:06d}.index"


def _digest(coder: Coder) -> str:
    """CRC-32 of a coder's tensors, which tells coders apart."""
    running = 0
    for name, array in sorted(coder.tensors().items()):
        running = zlib.crc32(
            np.ascontiguousarray(array).reshape(-1).view(np.uint8).data, zlib.crc32(name.encode(), running)
        )
    return f"{running:08x}"


class IndexFiles:
    """The index files of one map.  Reading raises StaleArrays if a file is of no use; a failed write is only logged."""

    def __init__(self, folder: Path, layout: Layout) -> None:
        """For the map in ``folder``."""
        self._folder = folder
        self._map = f"{layout.identity} {layout.dimension} {layout.precision}"
        self._rows_per_segment = layout.rows_per_segment
        self.group_size = segments_per_group(layout)
        """How many segments have their codes in one file."""
        self._coder: tuple[Coder, str] | None = None  # the last coder used, and its digest

    def _made_by(self, coder: Coder) -> str:
        if self._coder is None or self._coder[0] is not coder:
            self._coder = (coder, _digest(coder))
        return f"{self._map} {self._coder[1]}"

    def read_coder(self) -> Coder:
        """Read the map's coder."""
        try:
            return Coder.of(read_arrays(self._folder / "coder.index", "coder", self._map))
        except ValueError as error:
            raise StaleArrays(f"it holds no coder: {error}") from error

    def write_coder(self, coder: Coder) -> bool:
        """Write the map's coder; returns whether it was written."""
        return write_arrays(self._folder / "coder.index", "coder", self._map, coder.tensors())

    def group_entries(self, entries: Sequence[SegmentEntry], group: int) -> Sequence[SegmentEntry]:
        """The segments of a group; empty after the last group."""
        return entries[group * self.group_size : (group + 1) * self.group_size]

    def _group_of(self, coder: Coder, entries: Sequence[SegmentEntry]) -> str:
        listed = json.dumps([[segment.number, segment.rows, segment.checksum] for segment in entries])
        return f"{self._made_by(coder)} {hashlib.sha256(listed.encode()).hexdigest()}"

    def read_codes(self, coder: Coder, entries: Sequence[SegmentEntry]) -> Codes:
        """Read the codes of the rows of a group, whose segments are ``entries``."""
        path = self._folder / codes_name(entries[0].number // self.group_size)
        arrays = read_arrays(path, "codes", self._group_of(coder, entries))
        sketches, bits, scales = coder.shape
        rows = sum(segment.rows for segment in entries)
        wanted = {
            "sketches": ((rows, sketches), np.dtype("<u8")),
            "bits": ((rows, bits), np.dtype("<u8")),
            "scales": ((rows, scales), np.dtype("<f4")),
        }
        if {name: (array.shape, array.dtype) for name, array in arrays.items()} != wanted:
            raise StaleArrays("it holds other codes than expected")
        return Codes(arrays["sketches"], arrays["bits"], arrays["scales"])

    def write_codes(self, coder: Coder, entries: Sequence[SegmentEntry], codes: Codes) -> bool:
        """Write the codes of a group; returns whether they were written."""
        path = self._folder / codes_name(entries[0].number // self.group_size)
        arrays: Arrays = {"sketches": codes.sketches, "bits": codes.bits, "scales": codes.scales}
        return write_arrays(path, "codes", self._group_of(coder, entries), arrays)

    def read_lists(self, coder: Coder, rows: int, entries: Sequence[SegmentEntry]) -> tuple[InvertedLists, int]:
        """Read the lists of at most ``rows`` rows, and how many rows there were when their centres were computed.

        Lists are stale if the full segments among their rows are not those of ``entries``.
        """
        arrays = read_arrays(self._folder / "lists.index", "lists", self._made_by(coder))
        try:
            centred, listed = int(arrays.pop(_CENTRED)[0]), arrays.pop(_LISTED).tobytes()
            lists = InvertedLists.of(arrays)
        except (ValueError, LookupError) as error:
            raise StaleArrays(f"it holds no lists: {error}") from error
        if lists.rows > rows:
            raise StaleArrays("it lists rows that do not exist")
        if listed != self._full_within(entries, lists.rows):
            raise StaleArrays("it lists other rows than those of the map")
        return lists, centred

    def write_lists(self, coder: Coder, lists: InvertedLists, centred: int, entries: Sequence[SegmentEntry]) -> bool:
        """Write the lists; returns whether they were written."""
        listed = np.frombuffer(self._full_within(entries, lists.rows), np.uint8)
        arrays = {**lists.tensors(), _CENTRED: np.array([centred]), _LISTED: listed}
        return write_arrays(self._folder / "lists.index", "lists", self._made_by(coder), arrays)

    def _full_within(self, entries: Sequence[SegmentEntry], rows: int) -> bytes:
        """A digest of the full segments among the first ``rows`` rows; full segments never change."""
        full = entries[: rows // self._rows_per_segment]
        listed = json.dumps([[segment.number, segment.rows, segment.checksum] for segment in full])
        return hashlib.sha256(listed.encode()).digest()

    def read_recall(self, coder: Coder, tier: Tier) -> Recall:
        """Read the last recall that was measured in this tier."""
        arrays = read_arrays(self._folder / "recall.index", "recall", f"{self._made_by(coder)} {tier}")
        try:
            at_1, queries, shortlist, places = arrays["recall"].tolist()
            return Recall(at_1=at_1, queries=int(queries), shortlist=int(shortlist), places=int(places))
        except (KeyError, ValueError) as error:
            raise StaleArrays("it holds no recall") from error

    def write_recall(self, coder: Coder, tier: Tier, recall: Recall) -> bool:
        """Write the recall; returns whether it was written."""
        values = np.array([recall.at_1, recall.queries, recall.shortlist, recall.places])
        made_of = f"{self._made_by(coder)} {tier}"
        return write_arrays(self._folder / "recall.index", "recall", made_of, {"recall": values})

    def check(self, entries: Sequence[SegmentEntry], tier: Tier) -> tuple[int, list[str]]:
        """Read all files that a map of this tier should have; returns the bytes checked, and which files are stale."""
        if tier == "exact":
            return 0, []
        checked, stale = 0, []
        try:
            coder = self.read_coder()
            checked += check_arrays(self._folder / "coder.index", "coder", self._map)
        except StaleArrays as error:
            return 0, [f"coder.index: {error}"]
        full = [self.group_entries(entries, group) for group in range(len(entries) // self.group_size)]
        for group in full:
            if group[-1].rows < group[0].rows:
                continue  # the group still grows
            path = self._folder / codes_name(group[0].number // self.group_size)
            try:
                checked += check_arrays(path, "codes", self._group_of(coder, group))
            except StaleArrays as error:
                stale.append(f"{path.name}: {error}")
        if tier == "inverted":
            try:
                checked += check_arrays(self._folder / "lists.index", "lists", self._made_by(coder))
                self.read_lists(coder, sum(segment.rows for segment in entries), entries)
            except StaleArrays as error:
                stale.append(f"lists.index: {error}")
        return checked, stale

    def remove(self) -> None:
        """Delete all index files, because the map is searched exactly.

        Raises:
            OSError: the disk refuses.
        """
        for path in self._folder.glob("*.index"):
            path.unlink(missing_ok=True)
