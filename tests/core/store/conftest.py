from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from core.maps import MapSettings
from core.store import Directory, Map
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE

ROWS = 4


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def atlas(directory: Path) -> Iterator[Directory]:
    """With segments of four rows, so that a few places fill some."""
    atlas = Directory(directory, rows_per_segment=ROWS)
    yield atlas
    atlas.close()


@pytest.fixture
def lab(atlas: Directory) -> Map:
    return atlas.create("lab", ENCODER, DIMENSION, MapSettings(), local_shape=LOCAL_SHAPE)
