"""Descriptors with the shape of real ones: parts of unit length or zero, some places much alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.index import Coder, CodeTable

Array = NDArray[np.float32]

PART = 64


def descriptors(count: int, dimension: int = 1024, seed: int = 0) -> Array:
    """float32 [count, dimension]: parts of 64 values of twelve prototypes mixed with noise, four parts in ten empty."""
    random = np.random.default_rng(seed)
    parts = dimension // PART
    prototypes = np.random.default_rng(99).standard_normal((12, parts, PART))
    made = prototypes[random.integers(0, 12, count)] + 1.5 * random.standard_normal((count, parts, PART))
    made /= np.linalg.norm(made, axis=2, keepdims=True)
    made[random.random((count, parts)) < 0.4] = 0
    return made.reshape(count, dimension).astype(np.float32)


def second_looks(of: Array, seed: int = 1) -> Array:
    """The same places again, somewhat changed."""
    noise = np.random.default_rng(seed).standard_normal(of.shape) * (of != 0)
    return (of + 0.08 * noise).astype(np.float32)


def table_of(rows: Array) -> CodeTable:
    """Their codes."""
    coder = Coder.of(rows.shape[1])
    return CodeTable.empty(coder).appended(coder.encode(rows))
