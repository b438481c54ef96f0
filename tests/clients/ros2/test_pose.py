"""The pose that an answer gives."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from placerec_ros.planar import Datum, Planar
from placerec_ros.pose import (
    HEADING_VARIANCE,
    UNKNOWN_ANGLE,
    UNKNOWN_HEIGHT,
    PoseEstimate,
    estimate,
    estimate_of_rig,
    in_metres,
)


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


def test_where_odometry_is_contradicted_a_frame_that_is_recognized_counts_whatever_the_session_believes() -> None:
    measured = {"x": 40.0, "y": 2.0, "heading": 0.0, "spread": 0.3, "covariance": [0.5] * 36}
    single = {"verdict": "recognized", "pose": measured}
    believing: tuple[dict[str, Any], ...] = ({}, {"verdict": "unknown", "place": None, "candidates": []})
    for fields in believing:
        found = estimate(answer(single=single, motion="contradicted", **fields), 2.0)
        assert found is not None and found.source == "frame" and found.planar.x == 40.0
    assert estimate(answer(single={"verdict": "unknown"}, motion="contradicted", verdict="unknown"), 2.0) is None


@pytest.mark.parametrize(
    ("x", "spread"), [(40.0, 0.3), (15.0, 8.0)], ids=["in a dense map", "in a map of places far apart"]
)
def test_a_frame_that_is_recognized_far_from_the_belief_says_nothing(x: float, spread: float) -> None:
    """The belief may rest on odometry alone, and the frame may be wrong."""
    measured = {"x": x, "y": 2.0, "heading": 0.0, "spread": spread, "covariance": [0.5] * 36}
    assert estimate(answer(single={"verdict": "recognized", "pose": measured}, motion="odometry"), 2.0) is None


def test_the_belief_gives_the_pose_where_the_frame_alone_does_not() -> None:
    single = {"verdict": "ambiguous", "pose": None}
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


MOUNTS = {"front": Planar(0.3, 0.0, 0.0), "left": Planar(0.0, 0.2, math.radians(90))}
NAMES: dict[str, str | None] = {"front": "lens-front", "left": "lens-left"}


def of_rig(heading: float | None = 120.0, camera: str | None = "lens-left", **fields: Any) -> dict[str, Any]:
    """The answer to a rig: recognized at (1, 2), by a place half a metre away that a camera saw."""
    covariance = np.diag([0.5, 0.6, UNKNOWN_HEIGHT, 3.0, 3.0, 2.0]).ravel().tolist()
    place = {"id": "p1", "pose": {"x": 1.5, "y": 2.0, "heading": heading}, "camera": camera}
    far = {"id": "p2", "pose": {"x": 50.0, "y": 2.0, "heading": 0.0}, "camera": "lens-front"}
    found = {"x": 1.0, "y": 2.0, "heading": 75.0, "covariance": covariance}
    matches = [{"place": far}, {"place": place}]
    return {"verdict": "recognized", "place": place, "pose": found, "matches": matches, **fields}


def robot_of(answer: dict[str, Any], yaw: float | None = None) -> PoseEstimate:
    found = estimate_of_rig(answer, MOUNTS, NAMES, 2.0, yaw)
    assert found is not None
    return found


def test_the_robot_of_a_rig_is_where_the_answer_is_and_heads_as_the_camera_of_the_match_says() -> None:
    found = robot_of(of_rig())
    assert math.degrees(found.planar.yaw) == pytest.approx(30)
    # The camera to the left stands 0.2 m to the left of a base that heads 30 degrees to the left of x.
    assert (found.planar.x, found.planar.y) == pytest.approx((1.0 + 0.1, 2.0 - 0.2 * math.cos(math.radians(30))))
    covariance = np.reshape(found.covariance, (6, 6))
    assert covariance[5, 5] == pytest.approx(HEADING_VARIANCE)
    assert np.all(np.linalg.eigvalsh(covariance) > 0)


@pytest.mark.parametrize(("yaw", "found"), [(25.0, 30.0), (110.0, 120.0), (-170.0, 120.0)])
def test_of_cameras_with_one_name_that_counts_which_turns_the_robot_least(yaw: float, found: float) -> None:
    for camera in (None, "other"):
        turned = robot_of(of_rig(camera=camera), math.radians(yaw))
        assert math.degrees(turned.planar.yaw) == pytest.approx(found)


def test_the_heading_is_unknown_where_nothing_tells_it() -> None:
    for answer in (of_rig(camera=None), of_rig(heading=None)):
        assert robot_of(answer).covariance[35] == UNKNOWN_ANGLE


def test_a_rig_that_is_not_localized_has_no_pose() -> None:
    for answer in (of_rig(verdict="ambiguous"), of_rig(pose=None), of_rig(pose={"latitude": 1.0, "longitude": 2.0})):
        assert estimate_of_rig(answer, MOUNTS, NAMES, 2.0, None) is None


def test_the_answer_to_a_rig_in_degrees_becomes_one_in_metres() -> None:
    datum = Datum(48.8462, 2.3464)
    latitude, longitude, heading = datum.geographic(Planar(1.5, 2.0, math.radians(120)))
    there = {"latitude": latitude, "longitude": longitude, "heading": heading}
    place = {"id": "p1", "pose": there, "camera": "lens-left"}
    whole = of_rig(
        place=place, pose={**there, "covariance": of_rig()["pose"]["covariance"]}, matches=[{"place": place}]
    )
    found = estimate_of_rig(in_metres(whole, datum), MOUNTS, NAMES, 2.0, None)
    assert found is not None and math.degrees(found.planar.yaw) == pytest.approx(30)
    assert found.planar.then(MOUNTS["left"]).x == pytest.approx(1.5)
