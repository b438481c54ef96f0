"""Turns: long jobs give way to those of other maps, and can be cancelled while they wait."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest

from service.jobs.context import JobContext
from tests.service.jobs.test_jobs import Gate, end_of, running


def test_long_jobs_give_way_to_those_of_other_maps_in_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.jobs.context.SLICE_SECONDS", 0.0)
    order, ready = list[str](), threading.Event()

    def stepping(context: JobContext) -> dict[str, Any]:
        assert ready.wait(5)
        while (step := context.notes.get("step", 0)) < 3:
            order.append(f"{context.map_id}{context.arguments['name']}{step}")
            context.remember(step=step + 1)
            context.give_way()
        return {}

    with running(tmp_path, {"step": stepping}) as jobs:
        maps = ["x", "y", "x"]
        made = [jobs.submit("step", name, arguments={"name": "ab"[i // 2]}) for i, name in enumerate(maps)]
        ready.set()
        assert [end_of(jobs, job).state for job in made] == ["succeeded"] * 3
    assert [step for step in order if step.startswith("x")] == ["xa0", "xa1", "xa2", "xb0", "xb1", "xb2"]
    assert order.index("ya0") < order.index("xa2") and order.index("xa1") < order.index("ya2"), order


def test_a_job_that_has_given_way_is_cancelled_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.jobs.context.SLICE_SECONDS", 0.0)
    gate, ready = Gate(), threading.Event()

    def yielding(context: JobContext) -> dict[str, Any]:
        assert ready.wait(5)
        context.give_way()
        return {}

    with running(tmp_path, {"yielding": yielding, "gate": gate}) as jobs:
        patient, other = jobs.submit("yielding", "x"), jobs.submit("gate", "y")
        ready.set()
        assert gate.begun.wait(5) and jobs.get(patient.id).attempt == 1
        assert jobs.cancel(patient.id).state == "cancelled"
        gate.open.set()
        assert end_of(jobs, other).state == "succeeded" and jobs.get(patient.id).state == "cancelled"
