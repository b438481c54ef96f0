"""Two traverses of the same places and their ground truth."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidGroundTruth, InvalidTraverse
from core.frames.traverses import Truth


@dataclass(frozen=True)
class TraversePair:
    """A known traverse and a traverse to recognize.

    name: of the data set.
    references, queries: the full traverses, in order.
    truth: of each query, indices into ``references``, retained or not.
    retained: int64 [R'], ascending, indices of the references to match against.
    notes: sentences about the data that a reader of the figures must know.
    excluded: of each query, indices into ``references`` that it is not matched against; None where there are none.
    protocol: the name of the data set that ``placerec evaluate --list`` shows; empty for two folders.
    """

    name: str
    references: list[Path]
    queries: list[Path]
    truth: Truth
    retained: NDArray[np.int64]
    notes: list[str] = field(default_factory=list)
    excluded: Truth | None = None
    protocol: str = ""

    @property
    def retained_references(self) -> list[Path]:
        """The images to match against."""
        return [self.references[index] for index in self.retained]

    def negatives(self) -> int:
        """Queries without a retained true reference."""
        return count_negatives(self.truth, self.retained)


def all_references(references: list[Path]) -> NDArray[np.int64]:
    """The indices of all references, int64 [R]."""
    return np.arange(len(references), dtype=np.int64)


def limit(pair: TraversePair, retained: NDArray[np.int64]) -> TraversePair:
    """The pair with other retained references.

    Args:
        retained: int64 [R'], ascending.

    Raises:
        InvalidTraverse: a query would be matched against none of them.
    """
    for query, left_out in enumerate(pair.excluded or []):
        if np.isin(retained, left_out).all():
            raise InvalidTraverse(
                f"query {query} is matched against none of the {len(retained)} references that are retained."
            )
    return replace(pair, retained=retained)


def count_negatives(truth: Truth, retained: NDArray[np.int64]) -> int:
    """Queries without a retained true reference."""
    return sum(not np.isin(true, retained).any() for true in truth)


def leave_run_out(truth: Truth, references: int, keep: int, answerable: int, seed: int) -> NDArray[np.int64]:
    """The references that stay when one contiguous run is left out, so that new places are among the queries.

    The thesis gives counts only (Table 2.2), so which references go is our choice: of all runs that
    leave ``keep``, one that comes nearest to ``answerable`` queries, drawn by ``seed``.

    Args:
        truth: of each query.
        references: R.
        keep: R'.
        answerable: T', the queries that are to keep a true reference.

    Returns:
        int64 [R'], ascending.

    Raises:
        InvalidGroundTruth: there are not more references than are to be retained.
    """
    if not 0 < keep < references:
        raise InvalidGroundTruth(
            f"{keep} of {references} references cannot be retained: it must be fewer, and one at least."
        )
    removed = references - keep
    starts = np.arange(keep + 1)
    lost = sum(not len(true) for true in truth) + sum(
        ((starts <= true[0]) & (true[-1] < starts + removed)).astype(np.int64) for true in truth if len(true)
    )
    misses = np.abs(lost - (len(truth) - answerable))
    start = int(np.random.default_rng(seed).choice(starts[misses == misses.min()]))
    return np.concatenate([np.arange(start), np.arange(start + removed, references)]).astype(np.int64)
