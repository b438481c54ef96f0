"""Constraints against brute force over poses, on the circle and across the antimeridian; weights and what they do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.judgement.priors import (
    Constraint,
    Disc,
    Facing,
    GeographicBox,
    InSequences,
    NotLately,
    OnLevels,
    Period,
    decision_slope,
    holding,
    log_odds,
    log_weights,
    weighed,
)
from core.judgement.probability import Curve
from core.judgement.verdict import Calibration
from core.places import EARTH_RADIUS, GEOGRAPHIC, METRIC, NO_LEVEL, NO_POSE, NO_TIME, Pose, Whereabouts

CALIBRATION = Calibration(
    source="test", threshold=0.2, margin=0.01, background_mean=0.1, background_deviation=0.05,
    curve=Curve(slope=20, intercept=-4), decision="leading",
)  # fmt: skip

latitudes = st.floats(-90, 90)
longitudes = st.floats(-180, 180)
metres = st.floats(-1e4, 1e4)
angles = st.floats(-360, 360)


def places(poses: list[Pose | None], **columns: Sequence[float]) -> Whereabouts:
    kinds = {"metric": METRIC, "geographic": GEOGRAPHIC}
    n = len(poses)
    return Whereabouts(
        np.array([NO_POSE if pose is None else kinds[pose.kind()] for pose in poses], np.int8),
        np.array([np.zeros(3) if pose is None else pose.position() for pose in poses]).reshape(n, 3),
        np.array(columns.get("sequence", [-1] * n), np.int32),
        np.array(columns.get("ordinal", range(n)), np.int64),
        np.array([math.nan if pose is None or pose.heading is None else pose.heading for pose in poses], np.float32),
        np.array(columns.get("timestamp", [NO_TIME] * n), np.int64),
    )


def held(constraint: Constraint, *poses: Pose | None, **columns: Sequence[float]) -> list[bool]:
    found = places(list(poses), **columns)
    holds, fit = constraint.holds(found), constraint.fit(found)
    assert ((fit >= 0) & (fit <= 1)).all()
    return holds.tolist()


@given(metres, metres, metres, metres, st.floats(0, 1e4))
def test_a_disc_in_metres(x: float, y: float, here_x: float, here_y: float, radius: float) -> None:
    distance = math.dist((x, y), (here_x, here_y))
    if abs(distance - radius) > 1e-6:
        inside = held(Disc(Pose(x=here_x, y=here_y), radius), Pose(x=x, y=y, z=1e6))
        assert inside == [distance <= radius], "its height does not matter where none is given"


def test_a_disc_with_a_height_and_of_another_kind() -> None:
    disc = Disc(Pose(x=0, y=0, z=0), 5)
    assert held(disc, Pose(x=3, y=0, z=3), Pose(x=3, y=0, z=5), Pose(latitude=0, longitude=0), None) == [
        True, False, False, False,
    ]  # fmt: skip
    assert disc.fit(places([Pose(x=5, y=0)]))[0] == pytest.approx(math.exp(-0.5))
    assert held(Disc(Pose(x=1, y=2), 0), Pose(x=1, y=2), Pose(x=1, y=2.001)) == [True, False]


def great_circle(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Haversine, metres."""
    (p, t), (q, u) = ((math.radians(x), math.radians(y)) for x, y in (a, b))
    h = math.sin((p - q) / 2) ** 2 + math.cos(p) * math.cos(q) * math.sin((t - u) / 2) ** 2
    return 2 * EARTH_RADIUS * math.asin(math.sqrt(min(1.0, h)))


@given(latitudes, longitudes, latitudes, longitudes, st.floats(0, 2.1e7))
def test_a_disc_on_the_earth_is_measured_along_the_ground(p: float, t: float, q: float, u: float, r: float) -> None:
    distance = great_circle((p, t), (q, u))
    if abs(distance - r) > 1.0:
        assert held(Disc(Pose(latitude=q, longitude=u), r), Pose(latitude=p, longitude=t)) == [distance <= r]


@given(latitudes, longitudes, latitudes, longitudes, latitudes, longitudes)
@settings(max_examples=300)
def test_a_box(south: float, west: float, north: float, east: float, latitude: float, longitude: float) -> None:
    south, north = sorted((south, north))
    inside_height = south <= latitude <= north
    inside_width = west <= longitude <= east if west <= east else longitude >= west or longitude <= east
    edges = [abs(latitude - south), abs(latitude - north), abs(longitude - west), abs(longitude - east)]
    # Near a pole metres are few degrees of longitude and few of z: what rounding leaves open is not asked.
    if min(edges) < 1e-6 or abs(latitude) > 89.9 or abs(abs(longitude) - 180) < 1e-6:
        return
    expected = inside_height and inside_width
    assert held(GeographicBox(west, south, east, north), Pose(latitude=latitude, longitude=longitude)) == [expected]


def test_boxes_at_the_edges_of_the_map() -> None:
    fiji = GeographicBox(177, -20, -178, -15)
    inside = [Pose(latitude=-17, longitude=longitude) for longitude in (177, 180, -180, -179, -178)]
    assert held(fiji, *inside) == [True] * 5
    assert held(fiji, Pose(latitude=-17, longitude=0), Pose(latitude=-17, longitude=176.9)) == [False, False]
    assert held(GeographicBox(-180, -90, 180, 90), *inside, Pose(latitude=90, longitude=3)) == [True] * 6
    assert held(GeographicBox(10, 80, 20, 90), Pose(latitude=90, longitude=-77)) == [True], (
        "every meridian meets the pole"
    )
    meridian = GeographicBox(30, -10, 30, 10)
    assert held(meridian, Pose(latitude=1, longitude=30), Pose(latitude=1, longitude=-150)) == [True, False]
    assert held(fiji, Pose(x=0, y=0), None) == [False, False]


@given(angles, st.floats(0, 360, exclude_max=True), st.floats(0, 180))
def test_a_heading_on_the_circle(heading: float, here: float, tolerance: float) -> None:
    apart = min((here - heading) % 360, (heading - here) % 360)
    if abs(apart - tolerance) > 1e-3:
        facing = Facing(heading, tolerance)
        assert held(facing, Pose(x=0, y=0, heading=here), Pose(x=0, y=0), None) == [apart <= tolerance, False, False]


def test_a_period() -> None:
    times: list[float] = [5, 10, 20, 25, NO_TIME]
    nowhere: list[Pose | None] = [None] * 5
    assert held(Period(10, 20), *nowhere, timestamp=times) == [False, True, True, False, False]
    assert held(Period(None, 20), *nowhere, timestamp=times) == [True, True, True, False, False]
    assert held(Period(10, None), *nowhere, timestamp=times) == [False, True, True, True, False]


def test_ones_own_last_frames() -> None:
    own, other = 1, 2
    rows = {"sequence": [own, own, own, other, own], "ordinal": [0, 7, 8, 9, 9], "timestamp": [0, 70, 80, 90, NO_TIME]}
    nowhere: list[Pose | None] = [None] * 5
    assert held(NotLately(own, 8), *nowhere, **rows) == [True, True, False, True, False]
    assert held(NotLately(own, None, moment=100, span=25), *nowhere, **rows) == [True, True, False, True, False]
    assert held(NotLately(own, 9, moment=100, span=31), *nowhere, **rows) == [True, False, False, True, False]
    assert held(NotLately(3, 0), *nowhere, **rows) == [True] * 5
    assert held(InSequences((1, 5)), *nowhere, **rows) == [True, True, True, False, True]
    assert held(InSequences(()), *nowhere, **rows) == [False] * 5


def test_places_without_a_level_are_on_none_and_fit_any() -> None:
    where = replace(Whereabouts.along_sequence(range(3)), level=np.array([NO_LEVEL, 7, 8], np.int32))
    assert OnLevels((7, 9)).holds(where).tolist() == [False, True, False]
    assert OnLevels((7, 9)).fit(where).tolist() == [1, 1, 0]


def test_all_of_several() -> None:
    found = places([Pose(x=0, y=0, heading=0), Pose(x=0, y=0, heading=90), Pose(x=9, y=0, heading=0)])
    assert holding([Disc(Pose(x=0, y=0), 1), Facing(0, 10)], found).tolist() == [True, False, False]
    assert holding([], found).tolist() == [True] * 3


@given(st.lists(st.floats(0, 1), min_size=1, max_size=9), st.floats(0, 1))
def test_weights_take_and_never_give(fits: list[float], trust: float) -> None:
    weights = log_weights([np.array(fits)], trust)
    assert (weights <= 1e-12).all() and (weights >= math.log(1 - min(trust, 0.999)) - 1e-12).all()
    assert np.argsort(fits, kind="stable")[-1] in np.flatnonzero(weights >= weights.max() - 1e-12)


def test_what_is_soft_adds_its_log_weight_to_the_log_odds() -> None:
    weights = log_weights([np.array([1.0, 0.5, 0.0]), np.array([1.0, 0.5, 1.0])], 0.9)
    np.testing.assert_allclose(np.exp(weights), [1.0, 0.1 + 0.9 * 0.25, 0.1])
    scores = np.array([0.6, 0.5, 0.4], np.float32)
    after = weighed(scores, weights, CALIBRATION)
    np.testing.assert_allclose(decision_slope(CALIBRATION) * (after - scores), weights, rtol=1e-4)


def test_a_place_ruled_out_scores_no_less_than_what_is_unrelated() -> None:
    weights = np.full(3, math.log(0.001))
    after = weighed(np.array([0.3, 0.12, 0.02], np.float32), weights, CALIBRATION)
    np.testing.assert_allclose(after, [0.1, 0.1, 0.02], rtol=1e-6)


def test_log_odds_with_and_without_a_curve() -> None:
    assert log_odds(0.3, CALIBRATION) == pytest.approx(2)
    bare = CALIBRATION.model_copy(update={"curve": None})
    assert log_odds(0.2, bare) == pytest.approx(0) and log_odds(0, bare) == pytest.approx(-4)
