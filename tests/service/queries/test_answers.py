"""The JSON of an estimated pose."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from core.judgement.position import UNKNOWN_HEIGHT, PoseEstimate
from core.places import Place, Pose
from service.places.schemas import PlaceView
from service.queries.answers import estimated_pose


def place(pose: Pose | None) -> PlaceView:
    now = datetime(2026, 11, 22, tzinfo=UTC)
    return PlaceView.of(Place(id="p", pose=pose, regions=9, picture="none", created_at=now, updated_at=now))


@pytest.mark.parametrize("z", [None, 1.5])
def test_the_covariance_is_36_numbers_row_by_row(z: float | None) -> None:
    covariance = np.diag(np.arange(1.0, 7))
    covariance[0, 5] = covariance[5, 0] = covariance[2, 1] = covariance[1, 2] = 0.5
    estimate = PoseEstimate(
        Pose(x=1, y=2, z=z or 0, heading=90), 0.4, 2.0, 2, covariance, 3.5, 1.1, source="field-of-view"
    )
    shown = estimated_pose(estimate, place(Pose(x=1, y=2, z=z)))
    assert shown is not None
    told = shown.model_dump(mode="json")
    matrix = np.reshape(told["covariance"], (6, 6))
    assert len(told["covariance"]) == 36 and matrix[0, 5] == 0.5
    assert (matrix[2, 2], matrix[2, 1]) == ((UNKNOWN_HEIGHT, 0) if z is None else (3, 0.5))
    assert ("z" in told) == (z is not None)
    assert (told["heading_offset"], told["offset_spread"], told["source"]) == (3.5, 1.1, "field-of-view")


def test_what_no_view_tells_is_left_out() -> None:
    estimate = PoseEstimate(Pose(latitude=48, longitude=2), 3.0, None, 1)
    best = place(Pose(latitude=48, longitude=2))
    shown, noted = estimated_pose(estimate, best), estimated_pose(estimate, best, "They do not fit.")
    assert shown is not None and noted is not None and noted.model_dump()["note"] == "They do not fit."
    told = shown.model_dump(mode="json")
    assert (
        told["source"] == "places"
        and "note" not in told
        and "heading_offset" not in told
        and told["heading_spread"] is None
    )
    assert estimated_pose(None, place(None)) is None
