"""What is told of a map's index, and what is built, while writes come in at an unlucky moment."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from core.storage import Atlas, MapSettings
from core.storage.search.index_files import IndexFiles
from tests.core.storage.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame


def wait_for(is_so: Callable[[], bool]) -> None:
    until = time.monotonic() + 60
    while not is_so():
        assert time.monotonic() < until
        time.sleep(0.005)


def test_a_map_emptied_while_its_first_codes_are_made_is_searched_exactly(
    atlas: Atlas, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The write finds nothing built that would have to go; what builds has to look again at the end."""
    lab = atlas.create("lab", ENCODER, DIMENSION, MapSettings(index="compact"), LOCAL_SHAPE)
    kept = IndexFiles.write_coder

    def emptied(files: IndexFiles, coder: object) -> bool:
        for place in lab.places(None, 10)[0]:
            lab.forget(place.id)
        return kept(files, coder)  # type: ignore[arg-type]

    monkeypatch.setattr(IndexFiles, "write_coder", emptied)
    lab.enrol([frame("a"), frame("b")])
    wait_for(lambda: lab.index_status().state == "ready")
    status = lab.index_status()
    assert (status.tier, status.wanted) == ("exact", "exact")
