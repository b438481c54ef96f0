"""Queries of a map by its own places, while places are stored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from core.maps import MapSettings
from core.recognition.self_queries import SelfQueries
from tests.service.engines import ENCODER, enrolments, runtime_at


def test_a_place_listed_before_its_row_is_readable_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    no_encoder: Any = None  # no score is asked for
    with runtime_at(tmp_path) as runtime:
        map_ = runtime.engine.maps.create("lab", ENCODER, 8, MapSettings(keep="none"))
        map_.enrol(enrolments(0, 5, "l", "monday"))
        before = map_.snapshot()
        map_.enrol(enrolments(5, 3, "l", "monday"))
        assert len(SelfQueries(map_, no_encoder)) == 8
        # As it is between the commit of places and the snapshot that has them.
        monkeypatch.setattr(map_, "snapshot", lambda: before)
        own = SelfQueries(map_, no_encoder)
        assert [place.id for place in own.places] == [f"l{number}" for number in range(5)]
