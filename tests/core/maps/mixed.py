"""Maps whose places have coordinates of both kinds, as they could be made before a map had one kind."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from core.ledger.maps.writing import Write


@contextmanager
def both_kinds() -> Iterator[None]:
    """Have writes take poses of either kind."""
    with patch.object(Write, "_expect_coordinates", lambda *_: None):
        yield
