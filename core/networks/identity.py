"""Identities: SHA-256 over canonical JSON and over the contents of arrays."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def canonical_json(value: Any) -> str:
    """JSON with sorted keys, without white space and NaN: the same text for the same value."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True)


def json_digest(value: Any) -> str:
    """The SHA-256 of the canonical JSON of ``value``, hexadecimal."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def arrays_digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """The SHA-256 over names, dtypes (as torch writes them), shapes and values, in the order of names; hexadecimal."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.asarray(arrays[name], order="C")
        digest.update(canonical_json([name, f"torch.{array.dtype.name}", list(array.shape)]).encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
