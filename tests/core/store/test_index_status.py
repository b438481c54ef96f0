"""What is told of a map's index, and what is built, while writes come in at an unlucky moment."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from core.index import Coder, Codes
from core.maps import MapSettings
from core.store import Directory
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame


def wait_for(is_so: Callable[[], bool]) -> None:
    until = time.monotonic() + 60
    while not is_so():
        assert time.monotonic() < until
        time.sleep(0.005)


def test_a_map_emptied_while_its_first_codes_are_made_is_searched_exactly(
    atlas: Directory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The write finds nothing built that would have to go; what builds has to look again at the end."""
    lab = atlas.create("lab", ENCODER, DIMENSION, MapSettings(index="compact"), LOCAL_SHAPE)
    encode = Coder.encode

    def emptied(self: Coder, descriptors: NDArray[np.float32]) -> Codes:
        for place in lab.places(None, 10)[0]:
            lab.forget(place.id)
        return encode(self, descriptors)

    monkeypatch.setattr(Coder, "encode", emptied)
    lab.enrol([frame("a"), frame("b")])
    wait_for(lambda: lab.index_status().state == "ready")
    status = lab.index_status()
    assert (status.tier, status.wanted) == ("exact", "exact")
