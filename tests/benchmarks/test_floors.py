"""Two storeys that look alike, through a real service: a robot is recognized on its own storey or on none."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from benchmarks.day.floors import ROWS, FloorRow, drive, make_building
from benchmarks.day.walks import WalkPair, drawn
from placerec_client import Client
from tests.service.server import Server


@pytest.fixture(scope="module")
def building(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Client, WalkPair]]:
    walk, server = drawn(), Server(tmp_path_factory.mktemp("building")).wait()
    with Client(str(server.client.base_url)) as client:
        for levels in (False, True):
            make_building(client, f"levels-{levels}".lower(), walk, levels)
        yield client, walk
    assert server.stop() == 0


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_nobody_is_recognized_on_another_storey(building: tuple[Client, WalkPair], row: FloorRow) -> None:
    client, walk = building
    found = drive(client, f"levels-{row.levels}".lower(), walk, row)
    frames = sum(found.values()) - found["z between"]
    assert found["z between"] == 0
    assert found["wrong storey"] <= 0.05 * frames
    least = 0.8 if "level" in row.states else 0.4 if "height" in row.states else 0.0
    assert found["right"] >= least * frames
