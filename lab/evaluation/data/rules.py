"""Rules that say what is true, and what a query is not matched against, from the images of two traverses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from core.errors import InvalidTraverse
from core.frames.traverses import Truth, tolerance_truth
from lab.evaluation.data.poses import nearest_truth, read_poses, within_truth

Rule = Callable[[Sequence[Path], Sequence[Path]], Truth]
"""Indices of references for each query, from the images of queries and references, in that order."""


def frames(tolerance: int) -> Rule:
    """Query i is true at the references i - ``tolerance`` to i + ``tolerance``."""
    return lambda queries, references: tolerance_truth(len(queries), len(references), tolerance)


def around(tolerance: int) -> Rule:
    """The references of ``frames`` without the i-th itself."""

    def rule(queries: Sequence[Path], references: Sequence[Path]) -> Truth:
        near = tolerance_truth(len(queries), len(references), tolerance)
        return [found[found != query] for query, found in enumerate(near)]

    return rule


def every(step: int, tolerance: int) -> Rule:
    """Query i was taken with reference ``step`` · i, and is true up to ``tolerance`` references from it."""

    def rule(queries: Sequence[Path], references: Sequence[Path]) -> Truth:
        near = tolerance_truth(step * len(queries), len(references), tolerance)
        return near[::step]

    return rule


def nearest(tolerance: int) -> Rule:
    """A query is true at the reference nearest to its geotag and ``tolerance`` frames around that."""
    return lambda queries, references: nearest_truth(read_poses(queries), read_poses(references), tolerance)


def within(metres: float) -> Rule:
    """A query is true at the references within ``metres`` of its position."""
    return lambda queries, references: within_truth(read_poses(queries), read_poses(references), metres, None)


def groups() -> Rule:
    """Query i is true at the i-th group of references, all groups of one size.

    The rule raises InvalidTraverse where the references cannot be shared out evenly.
    """

    def rule(queries: Sequence[Path], references: Sequence[Path]) -> Truth:
        size, rest = divmod(len(references), len(queries))
        if rest or not size:
            raise InvalidTraverse(
                f"{len(references)} references cannot be shared out evenly over {len(queries)} queries: some are "
                "missing."
            )
        return [np.arange(index * size, (index + 1) * size, dtype=np.int64) for index in range(len(queries))]

    return rule
