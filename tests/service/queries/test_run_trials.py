"""What runs say of a map's answers: stored in either database, of the latest runs alone, and forgotten with a run."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from core.judgement.trials import StagedTrials, Trials
from core.learning import Witness
from service.queries.histories.run_trials import MOST_RUNS, RunTrials
from tests.service.queries.test_statistics import HALL, LAB, Counting, Maps, counting, maps

__all__ = ["Maps", "counting", "maps"]

BEGAN = datetime(2026, 11, 20, 8, 30, tzinfo=UTC)


def ran(run: str, count: int = 3, robot: str = "robot-7") -> RunTrials:
    """A run of some answers, of which one was not verified."""
    decision = np.linspace(0.1, 0.3, count)
    evidence = np.where(np.arange(count) == 0, np.nan, 9.0)
    flags = np.ones(count, np.bool_)
    two = Trials(decision, np.full(count, np.inf), flags, flags, np.arange(count))
    return RunTrials(run, Witness(robot, BEGAN), StagedTrials(two, replace(two, evidence=evidence)))


def test_trials_of_the_latest_runs_are_kept(counting: Counting) -> None:
    counted = counting()
    for number in range(MOST_RUNS + 3):
        counted.keep_run_trials(LAB, ran(f"s-{number}", 2 + number % 3))
    counted.keep_run_trials(HALL, ran("s-hall"))
    counted.close()
    again = counting()
    found = again.run_trials(LAB)
    assert [one.run for one in found] == [f"s-{number}" for number in range(3, MOST_RUNS + 3)]
    for one in found:
        expected = ran(one.run, len(one.trials)).trials.record()
        assert one.trials.record() == expected and one.source == Witness("robot-7", BEGAN)
    assert [one.run for one in again.run_trials(HALL)] == ["s-hall"]
    assert again.run_trials(("lab", "2027-01-01T00:00:00+00:00")) == [], "another map of the same name"
    again.close()


def test_many_runs_of_one_robot_leave_what_others_have_said(counting: Counting) -> None:
    counted = counting()
    for number in range(3):
        counted.keep_run_trials(LAB, ran(f"s-{number}"))
    for number in range(2 * MOST_RUNS):
        counted.keep_run_trials(LAB, ran(f"t-{number}", robot="robot-8"))
    found = [one.run for one in counted.run_trials(LAB)]
    assert found == ["s-0", "s-1", "s-2", *(f"t-{number}" for number in range(MOST_RUNS + 3, 2 * MOST_RUNS))]
    counted.close()


def test_two_parts_of_a_long_run_are_forgotten_together(counting: Counting) -> None:
    counted = counting()
    for run in ("s-1", "s-2", "s-1"):
        counted.keep_run_trials(LAB, ran(run))
    counted.forget_run_trials(LAB, "s-1")
    counted.forget_run_trials(HALL, "s-2")
    assert [one.run for one in counted.run_trials(LAB)] == ["s-2"]
    counted.close()
