"""Codes, what they have in common, and lists, on disk: made again where they are missing, stale or damaged.

coder.index         what all codes of the map have in common; made once, when the map gets its first codes
codes-….index       codes of a group of segments, by the rows and checksums that SQLite names of them
lists.index         rows by nearest centre
recall.index        what was measured of them
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from core.index import Coder, Codes, InvertedLists
from core.storage.database.ledger import NamedSegment
from core.storage.files.arrays import Arrays, StaleArrays, check_arrays, read_arrays, write_arrays
from core.storage.files.segment_files import Layout
from core.storage.search.tiers import Recall, Tier

GROUP_ROWS = 4096
"""Rows whose codes are one file, as far as segments divide it: some 9 MB of the default encoder's codes."""

_CENTRED, _LISTED = "centred", "listed"


def segments_per_group(layout: Layout) -> int:
    """Segments whose codes are one file."""
    return max(1, GROUP_ROWS // layout.rows_per_segment)


def codes_name(group: int) -> str:
    """File name of the codes of group ``group``, counted from 0."""
    return f"codes-{group + 1:06d}.index"


def _digest(coder: Coder) -> str:
    """Tells coders apart."""
    running = 0
    for name, array in sorted(coder.tensors().items()):
        running = zlib.crc32(
            np.ascontiguousarray(array).reshape(-1).view(np.uint8).data, zlib.crc32(name.encode(), running)
        )
    return f"{running:08x}"


class IndexFiles:
    """Of one map.  Reading raises StaleArrays where there is nothing good; writing that fails is only logged."""

    def __init__(self, folder: Path, layout: Layout) -> None:
        """Of the map in ``folder``."""
        self._folder = folder
        self._map = f"{layout.identity} {layout.dimension} {layout.precision}"
        self._rows_per_segment = layout.rows_per_segment
        self.group_size = segments_per_group(layout)
        """Segments whose codes are one file."""
        self._coder: tuple[Coder, str] | None = None  # the last one seen, and its digest

    def _made_by(self, coder: Coder) -> str:
        if self._coder is None or self._coder[0] is not coder:
            self._coder = (coder, _digest(coder))
        return f"{self._map} {self._coder[1]}"

    def read_coder(self) -> Coder:
        """What the codes of the map have in common."""
        try:
            return Coder.of(read_arrays(self._folder / "coder.index", "coder", self._map))
        except ValueError as error:
            raise StaleArrays(f"it holds no coder: {error}") from error

    def write_coder(self, coder: Coder) -> bool:
        """Keep it; whether it is kept."""
        return write_arrays(self._folder / "coder.index", "coder", self._map, coder.tensors())

    def named_group(self, named: Sequence[NamedSegment], group: int) -> Sequence[NamedSegment]:
        """What SQLite says of the segments of a group; empty behind the last."""
        return named[group * self.group_size : (group + 1) * self.group_size]

    def _group_of(self, coder: Coder, named: Sequence[NamedSegment]) -> str:
        listed = json.dumps([[segment.number, segment.rows, segment.checksum] for segment in named])
        return f"{self._made_by(coder)} {hashlib.sha256(listed.encode()).hexdigest()}"

    def read_codes(self, coder: Coder, named: Sequence[NamedSegment]) -> Codes:
        """Of the rows of a group, of which SQLite says ``named``."""
        path = self._folder / codes_name(named[0].number // self.group_size)
        arrays = read_arrays(path, "codes", self._group_of(coder, named))
        sketches, bits, scales = coder.shape
        rows = sum(segment.rows for segment in named)
        wanted = {
            "sketches": ((rows, sketches), np.dtype("<u8")),
            "bits": ((rows, bits), np.dtype("<u8")),
            "scales": ((rows, scales), np.dtype("<f4")),
        }
        if {name: (array.shape, array.dtype) for name, array in arrays.items()} != wanted:
            raise StaleArrays("it holds other codes than it must")
        return Codes(arrays["sketches"], arrays["bits"], arrays["scales"])

    def write_codes(self, coder: Coder, named: Sequence[NamedSegment], codes: Codes) -> bool:
        """Keep the codes of a group; whether they are kept."""
        path = self._folder / codes_name(named[0].number // self.group_size)
        arrays: Arrays = {"sketches": codes.sketches, "bits": codes.bits, "scales": codes.scales}
        return write_arrays(path, "codes", self._group_of(coder, named), arrays)

    def read_lists(self, coder: Coder, rows: int, named: Sequence[NamedSegment]) -> tuple[InvertedLists, int]:
        """Of at most the ``rows`` rows that have codes; and how many there were when their centres were found.

        They are of these rows: the full segments among them are those that SQLite has ``named``.
        """
        arrays = read_arrays(self._folder / "lists.index", "lists", self._made_by(coder))
        try:
            centred, listed = int(arrays.pop(_CENTRED)[0]), arrays.pop(_LISTED).tobytes()
            lists = InvertedLists.of(arrays)
        except (ValueError, LookupError) as error:
            raise StaleArrays(f"it holds no lists: {error}") from error
        if lists.rows > rows:
            raise StaleArrays("it lists rows that there are not")
        if listed != self._full_within(named, lists.rows):
            raise StaleArrays("it lists other rows than there are")
        return lists, centred

    def write_lists(self, coder: Coder, lists: InvertedLists, centred: int, named: Sequence[NamedSegment]) -> bool:
        """Keep them; whether they are kept."""
        listed = np.frombuffer(self._full_within(named, lists.rows), np.uint8)
        arrays = {**lists.tensors(), _CENTRED: np.array([centred]), _LISTED: listed}
        return write_arrays(self._folder / "lists.index", "lists", self._made_by(coder), arrays)

    def _full_within(self, named: Sequence[NamedSegment], rows: int) -> bytes:
        """Tells the full segments among the first ``rows`` rows from any others; full ones never change."""
        full = named[: rows // self._rows_per_segment]
        listed = json.dumps([[segment.number, segment.rows, segment.checksum] for segment in full])
        return hashlib.sha256(listed.encode()).digest()

    def read_recall(self, coder: Coder, tier: Tier) -> Recall:
        """What was measured last of this tier."""
        arrays = read_arrays(self._folder / "recall.index", "recall", f"{self._made_by(coder)} {tier}")
        try:
            at_1, queries, shortlist, places = arrays["recall"].tolist()
            return Recall(at_1=at_1, queries=int(queries), shortlist=int(shortlist), places=int(places))
        except (KeyError, ValueError) as error:
            raise StaleArrays("it holds no recall") from error

    def write_recall(self, coder: Coder, tier: Tier, recall: Recall) -> bool:
        """Keep it; whether it is kept."""
        values = np.array([recall.at_1, recall.queries, recall.shortlist, recall.places])
        made_of = f"{self._made_by(coder)} {tier}"
        return write_arrays(self._folder / "recall.index", "recall", made_of, {"recall": values})

    def check(self, named: Sequence[NamedSegment], tier: Tier) -> tuple[int, list[str]]:
        """Read all files that a map of this tier should have; bytes that are good, and what is stale."""
        if tier == "exact":
            return 0, []
        checked, stale = 0, []
        try:
            coder = self.read_coder()
            checked += check_arrays(self._folder / "coder.index", "coder", self._map)
        except StaleArrays as error:
            return 0, [f"coder.index: {error}"]
        full = [self.named_group(named, group) for group in range(len(named) // self.group_size)]
        for group in full:
            if group[-1].rows < group[0].rows:
                continue  # it still grows
            path = self._folder / codes_name(group[0].number // self.group_size)
            try:
                checked += check_arrays(path, "codes", self._group_of(coder, group))
            except StaleArrays as error:
                stale.append(f"{path.name}: {error}")
        if tier == "inverted":
            try:
                checked += check_arrays(self._folder / "lists.index", "lists", self._made_by(coder))
                self.read_lists(coder, sum(segment.rows for segment in named), named)
            except StaleArrays as error:
                stale.append(f"lists.index: {error}")
        return checked, stale

    def remove(self) -> None:
        """All of them, for a map that is searched exactly.

        Raises:
            OSError: the disk refuses.
        """
        for path in self._folder.glob("*.index"):
            path.unlink(missing_ok=True)
