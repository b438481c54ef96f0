"""The best of many estimates, and work shared with other threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor

import numpy as np
from numpy.typing import NDArray

from core.kernels.codes import count_from, gather_from
from core.threads import cores, in_turns

Array = NDArray[np.float32]
Rows = NDArray[np.int64]

_SAMPLED = 4096


def best_first(estimates: Array, count: int) -> Rows:
    """Where the ``count`` highest estimates are, best first, equal ones by position; all where there are fewer."""
    if count >= len(estimates):
        return np.argsort(-estimates, kind="stable")
    if count < 1:
        return np.empty(0, np.int64)
    limit = -np.partition(-estimates, count - 1)[count - 1]
    # Of those that equal the limit the first are taken.
    positions = np.flatnonzero(estimates >= limit)
    return positions[np.argsort(-estimates[positions], kind="stable")[:count]]


def best_positions(estimates: Array, count: int) -> Rows:
    """The same positions, ascending: where the ``count`` highest estimates are."""
    if count >= len(estimates):
        return np.arange(len(estimates))
    # A limit is read off a regular sample, with a margin, so that few are left to be sorted: sorting all of them would
    # take longer than estimating them.
    every = max(1, len(estimates) // _SAMPLED)
    sample = np.sort(estimates[::every])[::-1]
    expected = count / every
    limit = sample[min(len(sample) - 1, int(expected + 3 * np.sqrt(expected)) + 3)]
    found = int(count_from(estimates, limit))
    if found < count:  # the sample was unlike the rest
        return np.sort(best_first(estimates, count))
    positions = np.empty(found, np.int64)
    gather_from(estimates, limit, positions)
    values = estimates[positions]
    last = np.partition(values, found - count)[found - count] if count else np.inf
    kept = values > last
    kept[np.flatnonzero(values == last)[: count - int(np.count_nonzero(kept))]] = True
    return positions[kept]


def together(tasks: Sequence[Callable[[], None]], executor: Executor | None) -> None:
    """Run every task once, in the calling thread and in those of the executor."""
    in_turns(lambda task: task(), tasks, executor, min(len(tasks), cores()) - 1)
