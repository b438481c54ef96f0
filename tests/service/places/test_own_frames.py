"""A map held against itself while it is written to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from core.storage import MapSettings
from service.places.own_frames import OwnFrames
from tests.service.engines import ENCODER, engine_at, enrolments


def test_a_place_that_is_listed_before_its_row_can_be_read_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    no_encoder: Any = None  # no score is asked for
    with engine_at(tmp_path) as engine:
        map_ = engine.atlas.create("lab", ENCODER, 8, MapSettings(keep="none"))
        map_.enrol(enrolments(0, 5, "l", "monday"))
        before = map_.snapshot()
        map_.enrol(enrolments(5, 3, "l", "monday"))
        assert len(OwnFrames(map_, no_encoder)) == 8
        # As it is between the commit of places and the snapshot that has them.
        monkeypatch.setattr(map_, "snapshot", lambda: before)
        own = OwnFrames(map_, no_encoder)
        assert [place.id for place in own.places] == [f"l{number}" for number in range(5)]
