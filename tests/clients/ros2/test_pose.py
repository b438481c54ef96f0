"""The pose that an answer gives."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from placerec_ros.pose import HEADING_VARIANCE, UNKNOWN_ANGLE, UNKNOWN_HEIGHT, estimate


def answer(**fields: Any) -> dict[str, Any]:
    """A session's answer: recognized at (1, 2), and so is the frame alone."""
    pose = {"x": 1.0, "y": 2.0, "heading": 90.0}
    measured = {"x": 1.2, "y": 2.1, "heading": 350.0, "spread": 0.3, "covariance": list(range(36))}
    place = {"id": "p1", "pose": pose}
    return {
        "verdict": "recognized",
        "place": place,
        "candidates": [{"probability": 0.9, "place": place}],
        "single": {"verdict": "recognized", "place": place, "pose": measured},
        **fields,
    }


def test_the_pose_of_the_frame_is_taken_with_its_covariance() -> None:
    found = estimate(answer(), 2.0)
    assert found is not None
    assert found.source == "frame"
    assert (found.planar.x, found.planar.y, math.degrees(found.planar.yaw)) == pytest.approx((1.2, 2.1, -10))
    assert found.covariance == tuple(map(float, range(36)))


@pytest.mark.parametrize(
    "fields",
    [
        {"verdict": "unknown", "place": None},
        {"verdict": "ambiguous", "place": None},
        {"place": {"id": "p1", "pose": None}},
        {"place": {"id": "p1", "pose": {"latitude": 48.0, "longitude": 2.0}}},
    ],
)
def test_nothing_is_said_while_not_localized(fields: dict[str, Any]) -> None:
    assert estimate(answer(**fields), 2.0) is None


@pytest.mark.parametrize(
    "single",
    [
        {"verdict": "ambiguous", "pose": None},
        {"verdict": "recognized", "pose": {"x": 40.0, "y": 2.0, "spread": 0.3, "covariance": [0.0] * 36}},
    ],
    ids=["the frame alone is not", "the frame alone is elsewhere"],
)
def test_the_belief_gives_the_pose_where_the_frame_alone_does_not(single: dict[str, Any]) -> None:
    near = {"id": "p1", "pose": {"x": 1.0, "y": 2.0, "heading": 10.0}}
    far = {"id": "p9", "pose": {"x": 11.0, "y": 2.0, "heading": 350.0}}
    candidates = [{"probability": 0.6, "place": near}, {"probability": 0.2, "place": far}]
    found = estimate(answer(single=single, place=near, candidates=candidates), 2.0)
    assert found is not None
    assert found.source == "belief"
    assert (found.planar.x, found.planar.y) == (1.0, 2.0)
    covariance = np.array(found.covariance).reshape(6, 6)
    assert covariance[0, 0] == pytest.approx(1.0 + 0.25 * 10**2), "the disc of a place, and the rival 10 m away"
    assert covariance[1, 1] == pytest.approx(1.0)
    assert covariance[2, 2] == UNKNOWN_HEIGHT
    assert covariance[3, 3] == covariance[4, 4] == UNKNOWN_ANGLE
    assert covariance[5, 5] == pytest.approx(HEADING_VARIANCE + 0.25 * math.radians(20) ** 2)
    assert np.all(np.linalg.eigvalsh(covariance) > 0)
    np.testing.assert_array_equal(covariance, covariance.T)


def test_a_place_without_a_heading_has_none() -> None:
    place = {"id": "p1", "pose": {"x": 1.0, "y": 2.0}}
    single = {"verdict": "unknown", "pose": None}
    found = estimate(answer(single=single, place=place, candidates=[{"probability": 1.0, "place": place}]), 2.0)
    assert found is not None
    assert found.covariance[35] == UNKNOWN_ANGLE
