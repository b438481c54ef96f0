"""A pruning that is interrupted: the places that it chose are removed once, and no others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from core.storage import MapSettings
from core.storage.transfer import Transfer
from service.engine.engine import Engine
from service.jobs.context import JobInterrupted
from service.upkeep import pruning
from tests.service.engines import ENCODER, end_of, enrolments, runtime_at
from tests.service.map_jobs import wait_until

GOING = ("l1", "l3", "l5")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A map of eight places and a made-up plan to remove three, since nothing can be encoded here."""
    with runtime_at(tmp_path) as runtime:
        runtime.engine.atlas.create("lab", ENCODER, 8, MapSettings(keep="none")).enrol(enrolments(0, 8, "l", "monday"))
    planned = 0

    def plan(engine: Engine, _: Any) -> tuple[dict[str, Any], dict[str, str]]:
        nonlocal planned
        planned += 1
        assert planned == 1, "a second plan would prune the pruned map again"
        there = engine.atlas.get("lab").transfer.outline()
        return {"removed": 3}, {place.id: place.digest.hex() for place in there if place.id in GOING}

    monkeypatch.setattr(pruning, "_plan", plan)
    return tmp_path


@pytest.mark.parametrize("when", ["before it goes", "after it went"])
def test_a_kill_around_the_commit(folder: Path, monkeypatch: pytest.MonkeyPatch, when: str) -> None:
    forget = Transfer.forget

    def broken_off(self: Transfer, frames: dict[str, bytes]) -> int:
        if when == "after it went":
            forget(self, frames)
        runtime.jobs.stop_soon()
        raise JobInterrupted

    with runtime_at(folder) as runtime, monkeypatch.context() as broken:
        broken.setattr(Transfer, "forget", broken_off)
        job = runtime.jobs.submit(pruning.KIND, "lab", arguments={"dry_run": False})
        wait_until(lambda: runtime.jobs.stopping)
    with runtime_at(folder) as runtime:
        done = end_of(runtime, job)
        assert (done.state, done.attempt, done.result) == ("succeeded", 2, {"removed": 3, "places_after": 5})
        left = [place.id for place in runtime.engine.atlas.get("lab").transfer.outline()]
        assert left == ["l0", "l2", "l4", "l6", "l7"]


def test_a_place_that_has_another_frame_by_now_stays(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with runtime_at(folder) as runtime:
        lab = runtime.engine.atlas.get("lab")
        plan = pruning._plan

        def and_then(*arguments: Any) -> Any:
            found = plan(*arguments)
            (other,) = enrolments(100, 1, "l", "monday")
            lab.enrol([type(other)("l3", other.fields, other.descriptor, 5, other.digest)])
            return found

        monkeypatch.setattr(pruning, "_plan", and_then)
        done = end_of(runtime, runtime.jobs.submit(pruning.KIND, "lab", arguments={"dry_run": False}))
        assert done.result == {"removed": 3, "places_after": 6}
        assert "l3" in [place.id for place in lab.transfer.outline()]
