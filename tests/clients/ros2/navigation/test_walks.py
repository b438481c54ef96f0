"""The filter on simulated walks: what it publishes is within its deviations, whatever odometry says."""

from __future__ import annotations

import pytest

from tests.clients.ros2.navigation.walks import FAULTS, along

SEEDS = range(1, 9)


def test_right_odometry_is_followed_as_surely_as_without_doubts() -> None:
    """The filter that knew no doubts had the same error and share, and a deviation of 0.82 m."""
    found = along("", 0.0, SEEDS)
    assert found.within >= 0.985 and found.turned >= 0.99
    assert found.error <= 0.82 and found.deviation <= 0.86
    assert found.sent >= 0.96, "it is sent as soon as the heading is known"


@pytest.mark.parametrize("begin", [0.0, 0.4], ids=["from the start", "from the middle"])
@pytest.mark.parametrize("fault", FAULTS)
def test_with_odometry_at_fault_the_pose_is_within_three_deviations(fault: str, begin: float) -> None:
    """Of twenty walks 0.99 are, but for a scale of 0.3; in the first frames of a fault nothing can tell it yet."""
    found = along(fault, begin, SEEDS)
    assert found.within >= 0.975 and found.turned >= 0.97
    assert found.error <= 1.5, "the localizations alone are followed"
