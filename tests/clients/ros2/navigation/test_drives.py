"""The transform along drives whose answers a service gave; ``benchmarks.clients.map_to_odom --record`` wrote them."""

from __future__ import annotations

import pytest

from benchmarks.clients.drives import FOLDERS, read
from benchmarks.clients.map_to_odom import MEDIAN, MOST, RECORDED, WITHIN, Course, by_itself, filtered, with_wrong_ones


@pytest.mark.parametrize("name", FOLDERS)
@pytest.mark.parametrize("wrong", [False, True], ids=["as answered", "every tenth is wrong"])
def test_the_transform_can_be_driven_by(name: str, wrong: bool) -> None:
    drive = read(RECORDED / f"{name}.csv")
    found = filtered(with_wrong_ones(drive) if wrong else drive, Course()).figures()
    assert found["jump_median"] <= MEDIAN and found["jump_p95"] <= MOST
    assert found["jumps_without_evidence"] == 0
    assert found["within_3_position"] >= WITHIN and found["within_3_heading"] >= WITHIN
    assert found["silent"] < 20, "it is sent soon"


@pytest.mark.parametrize("name", FOLDERS)
def test_it_is_better_than_answers_by_themselves(name: str) -> None:
    drive = read(RECORDED / f"{name}.csv")
    alone, together = by_itself(drive, Course()).figures(), filtered(drive, Course()).figures()
    assert together["jump_p95"] < alone["jump_p95"] / 3
    assert together["error_p95"] < alone["error_p95"]
