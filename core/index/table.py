"""The codes of a map in memory, and the search over them.

Codes lie in blocks.  Rows are appended to the last block, whose memory has room behind the rows that are there: a
search names the rows that it may find, so rows that are written meanwhile disturb none.  In the background blocks are
joined into larger ones, of which not every code has to be read: FAISS's fast scan over the first of the rotated values
(``IndexIVFRaBitQFastScan`` with one list, which takes selectors) picks out candidates, and ``IndexRefine`` compares the
whole codes of those.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple, Protocol

import faiss
import numpy as np

from core.index.codes import Coder, Codes
from core.index.flat import Array, Flags, Positions, in_one_thread, selector, stored
from core.threads import cores, in_turns

ROWS_PER_BLOCK = 1024
"""Rows of a block that is appended to."""
LARGEST_BLOCK = 65_536
LOOSE_ROWS = 8192
"""Blocks that are not scanned are joined from this number of rows on: then reading every code takes too long."""
SCANNED_VALUES = 2048
"""Number of rotated values by which the fast scan ranks rows; below twice as many, all codes are compared."""
CANDIDATES, FEWEST_CANDIDATES = 8.0, 3.0
"""Number of rows that a scan leaves for each row of the shortlist, to compare their whole codes; divided by
the root of the
number of blocks, down to the fewest, since only one block has the row that is looked for."""
SHARED_FROM = 16_384
"""From this number of rows on, a search is shared among threads."""
_DECODED = 256
"""Rows that are decoded at a time."""

Progress = Callable[[int, int], None]


def _unreported(done: int, total: int) -> None:
    pass


@dataclass(frozen=True, eq=False)
class Block:
    """Rows ``first`` … ``first + used`` of a table.

    codes: the index of their codes; behind them there may be room.
    scan: the same rows, of which a scan picks out candidates first; None where all codes are compared.
    """

    first: int
    used: int
    codes: faiss.IndexRaBitQ
    scan: faiss.IndexRefine | None = None

    @property
    def is_full(self) -> bool:
        """Whether no row will be added."""
        return bool(self.used == self.codes.ntotal)

    @property
    def memory(self) -> int:
        """Bytes of the rows, room included."""
        scanned = 0 if self.scan is None else self.used * (SCANNED_VALUES // 8 + 16)  # factors and ids beside the bits
        return int(self.codes.ntotal * self.codes.code_size + scanned)

    def best(
        self, queries: Array, count: int, allowed: Flags | None, candidates: float = CANDIDATES
    ) -> tuple[Array, Positions]:
        """Estimates and rows of the table, float32 and int64 [B, count], -1 where there are fewer.

        Args:
            queries: rotated, float32 [B, D'].
            allowed: bool [used], which rows may be returned; None: all.
            candidates: rows that a scan leaves for each that is returned.
        """
        if allowed is None and not self.is_full:
            allowed = np.ones(self.used, np.bool_)
        chosen = None
        if allowed is not None:
            flags = np.zeros(self.codes.ntotal, np.bool_)
            flags[: self.used] = allowed
            chosen = selector(flags)
        found = self.used if allowed is None else int(np.count_nonzero(allowed))
        if self.scan is None or found <= candidates * count:
            index = self.codes
            parameters = faiss.SearchParameters(sel=chosen)
        else:
            index = self.scan
            base = faiss.SearchParametersPreTransform(index_params=faiss.SearchParametersIVF(sel=chosen, nprobe=1))
            parameters = faiss.IndexRefineSearchParameters(k_factor=candidates, base_index_params=base)
        with in_one_thread():
            estimates, rows = index.search(queries, min(count, self.used), params=parameters)
        return estimates, np.where(rows < 0, -1, rows + self.first)


class Shortlist(NamedTuple):
    """rows int64 [n] and estimated inner products float32 [n], best first; equal ones by row."""

    rows: Positions
    estimates: Array


class FirstStage(Protocol):
    """Chooses, among rows 0 … n of a map, those whose descriptors are compared exactly.  An immutable value."""

    def __len__(self) -> int:
        """n; the rows behind them are compared by whoever asks."""

    @property
    def coder(self) -> Coder:
        """Makes codes of descriptors."""

    @property
    def memory(self) -> int:
        """Bytes in this process."""

    @property
    def is_lost(self) -> bool:
        """Whether nothing can be found in it any more, so that another has to be made."""

    def appended(self, codes: Codes) -> FirstStage:
        """With the codes of further rows, or, if they come into it in another way, as it is."""

    def shortlists(
        self, queries: Array, count: int, allowed: Flags | None = None, executor: Executor | None = None
    ) -> list[Shortlist]:
        """For each query the ``count`` rows with the highest estimates, fewer where there are not as many.

        Args:
            queries: float32 [B, D].
            allowed: bool [n], which rows may be returned (living and chosen by a filter); None: all.
            executor: may share the work; the calling thread takes part.  Not one whose threads call this.

        Raises:
            ValueError: ``allowed`` is not of one value a row, or the queries are of another length.
            StoreUnavailable: a server that has the rows cannot be reached, refuses, or has lost them.
        """


@dataclass(frozen=True, eq=False)
class CodeTable:
    """The codes of rows 0 … n of a map, an immutable value: appending gives a new one that shares its memory.

    A code is never changed: a deleted place is left out by ``allowed``; a place whose descriptor changed has a new row.
    """

    coder: Coder
    blocks: tuple[Block, ...] = ()
    is_lost: ClassVar[bool] = False

    @classmethod
    def empty(cls, coder: Coder) -> CodeTable:
        """Without rows."""
        return cls(coder)

    def __len__(self) -> int:
        return self.blocks[-1].first + self.blocks[-1].used if self.blocks else 0

    @property
    def memory(self) -> int:
        """Bytes of all blocks."""
        return sum(block.memory for block in self.blocks)

    def appended(self, codes: Codes) -> CodeTable:
        """With further rows.  Only on the newest table, by one thread at a time."""
        blocks, done = list(self.blocks), 0
        while done < len(codes):
            if not blocks or blocks[-1].is_full:
                # Many rows at once, such as those of a file, get a block of their own size.
                room = min(LARGEST_BLOCK, max(ROWS_PER_BLOCK, len(codes) - done))
                first = blocks[-1].first + blocks[-1].used if blocks else 0
                blocks.append(Block(first, 0, self.coder.index(room)))
            last = blocks[-1]
            used = min(last.codes.ntotal, last.used + len(codes) - done)
            stored(last.codes)[last.used : used] = codes[done : done + used - last.used]
            blocks[-1], done = replace(last, used=used), done + used - last.used
        return replace(self, blocks=tuple(blocks))

    def codes(self, start: int, stop: int) -> Codes:
        """A copy of the codes of rows start … stop."""
        parts = [self.coder.blank(0)]
        for block in self.blocks:
            rows = slice(max(0, start - block.first), max(0, min(block.used, stop - block.first)))
            parts.append(stored(block.codes)[rows])
        return np.concatenate(parts)

    def shortlists(
        self, queries: Array, count: int, allowed: Flags | None = None, executor: Executor | None = None
    ) -> list[Shortlist]:
        """As of :class:`FirstStage`, with estimated inner products."""
        if allowed is not None and allowed.shape != (len(self),):
            raise ValueError(f"which rows are allowed is said of all {len(self)}")
        turned = self.coder.rotated(queries)
        helpers = cores() - 1 if executor is not None and len(self) >= SHARED_FROM else 0
        # A thread takes a block; where there are fewer blocks than threads, some of the queries.
        scans = sum(block.scan is not None for block in self.blocks)
        candidates = max(FEWEST_CANDIDATES, CANDIDATES / max(1, scans) ** 0.5)
        portions = min(len(turned), -(-(1 + helpers) // max(1, len(self.blocks))))
        found: dict[tuple[int, int], tuple[Array, Positions]] = {}

        def search(part: tuple[int, int]) -> None:
            number, portion = part
            block, some = self.blocks[number], turned[portion::portions]
            of_block = None if allowed is None else allowed[block.first : block.first + block.used]
            found[part] = block.best(some, count, of_block, candidates)

        parts = [(number, portion) for number in range(len(self.blocks)) for portion in range(portions)]
        in_turns(search, parts, executor, min(helpers, len(parts) - 1))
        return [
            _merged([found[number, i % portions] for number in range(len(self.blocks))], i // portions, count)
            for i in range(len(turned))
        ]

    @cached_property
    def is_loose(self) -> bool:
        """Whether enough rows are in loose blocks that :meth:`joined` makes a larger one of them."""
        return sum(block.used for block in self.blocks if block.is_full and self._is_small(block)) >= LOOSE_ROWS

    @property
    def _can_scan(self) -> bool:
        return self.coder.width >= 2 * SCANNED_VALUES

    def _is_small(self, block: Block) -> bool:
        """Whether a block would better be part of a larger one: it has no scan, or too few rows where none has."""
        return block.scan is None if self._can_scan else block.used < LOOSE_ROWS

    def joined(self, progress: Progress = _unreported) -> Block | None:
        """A block that can take the place of some smaller ones; None while these have few rows.

        Args:
            progress: called with the number of rows done and of all; its exceptions end the work.
        """
        if not self.is_loose:
            return None
        start = next(number for number, block in enumerate(self.blocks) if self._is_small(block))
        if start and self.blocks[start - 1].used + self.blocks[start].used <= LARGEST_BLOCK:
            start -= 1
        first, stop = self.blocks[start].first, self.blocks[start].first
        for block in self.blocks[start:]:
            if not block.is_full or block.first + block.used - first > LARGEST_BLOCK:
                break
            stop = block.first + block.used
        return self._larger(first, stop, progress)

    def _larger(self, first: int, stop: int, progress: Progress) -> Block:
        """A new block of the rows first … stop, with a scan if descriptors are long enough for one."""
        index = self.coder.index(stop - first)
        stored(index)[:] = self.codes(first, stop)
        if not self._can_scan:
            return Block(first, stop - first, index)
        lists = faiss.IndexFlatIP(SCANNED_VALUES)
        lists.add(np.zeros((1, SCANNED_VALUES), np.float32))  # the centre of the only list
        scan = faiss.IndexIVFRaBitQFastScan(lists, SCANNED_VALUES, 1, faiss.METRIC_INNER_PRODUCT)
        scan.train(np.zeros((1, SCANNED_VALUES), np.float32))
        for begin in range(0, stop - first, _DECODED):
            # Signs say all that the scan keeps, so that no descriptor has to be read again.
            some = min(_DECODED, stop - first - begin)
            signs = self.coder.decoded(stored(index)[begin : begin + some], SCANNED_VALUES)
            with in_one_thread():
                scan.add(signs)
            progress(begin + some, stop - first)
        heads = faiss.RemapDimensionsTransform(self.coder.width, SCANNED_VALUES, False)
        return Block(first, stop - first, index, faiss.IndexRefine(faiss.IndexPreTransform(heads, scan), index))

    def with_block(self, joined: Block) -> CodeTable:
        """With a block of :meth:`joined` in the place of those whose rows it has; they have not changed since."""
        end = joined.first + joined.used
        before = [block for block in self.blocks if block.first < joined.first]
        after = [block for block in self.blocks if block.first >= end]
        return replace(self, blocks=(*before, joined, *after))


def _merged(parts: list[tuple[Array, Positions]], query: int, count: int) -> Shortlist:
    """The best of what the blocks found for a query."""
    if not parts:
        return Shortlist(np.empty(0, np.int64), np.empty(0, np.float32))
    rows = np.concatenate([rows[query] for _, rows in parts])
    estimates = np.concatenate([estimates[query] for estimates, _ in parts])
    order = np.lexsort((rows, -estimates))
    order = order[rows[order] >= 0][:count]
    return Shortlist(rows[order], estimates[order])
