"""Witnesses: two robots, or one half a day apart; midnight makes no second one."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import pytest

from core.learning import Witness, count_witnesses

LATE = datetime(2026, 11, 20, 23, 50, tzinfo=UTC)


@pytest.mark.parametrize(
    ("robot", "later", "independent"),
    [
        ("robot-7", timedelta(minutes=20), False),
        ("robot-7", timedelta(hours=12) - timedelta(seconds=1), False),
        ("robot-7", timedelta(hours=12), True),
        ("robot-8", timedelta(0), True),
    ],
)
def test_runs_are_independent_by_robot_or_by_half_a_day(robot: str, later: timedelta, independent: bool) -> None:
    first, second = Witness("robot-7", LATE), Witness(robot, LATE + later)
    assert first.independent_of(second) is independent and second.independent_of(first) is independent
    assert count_witnesses([second, first]) == 1 + independent


def test_runs_that_follow_one_another_all_day_are_as_many_witnesses_as_half_days() -> None:
    runs = [Witness("robot 7", LATE + timedelta(hours=hour)) for hour in range(25)]
    assert count_witnesses(runs) == 3 and count_witnesses(runs[:12]) == 1 and count_witnesses([]) == 0


def test_a_witness_is_stored_as_a_text() -> None:
    one = Witness("robot 7", LATE.astimezone(timezone(timedelta(hours=9))))
    assert str(one) == "robot 7 2026-11-20T23:50:00+00:00" and Witness.of(str(one)) == one
    assert Witness.of("robot 7 2026-11-20") == Witness("robot 7", datetime(2026, 11, 20, tzinfo=UTC))
    with pytest.raises(ValueError, match="robot"):
        Witness.of("robot")
