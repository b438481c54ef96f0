"""Values of metadata as short texts, by which PostgreSQL and Milvus find places."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any


def tokens_of(metadata: Mapping[str, Any]) -> list[str]:
    """A token for each value at the top level that is no list and no object, in any order.

    Equal values under equal keys have equal tokens: numbers are equal as numbers (1 and 1.0), and true is not 1.  A
    token has 64 bits, so that different values have the same one as good as never.
    """
    return [_token(key, value) for key, value in metadata.items() if not isinstance(value, dict | list)]


def _token(key: str, value: Any) -> str:
    number = isinstance(value, float) and value.is_integer()
    text = json.dumps([key, int(value) if number else value])
    return hashlib.sha256(text.encode()).hexdigest()[:16]
