"""A query among places whose poses are known, in scenes that are made of points, where all is known.

The car drives ahead: places and query are nearly on one line, so directions alone do not meet.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.geometry.bundle import Stand, _Bundle, _State, bundle_stand
from core.geometry.pose import BODY, SharedPoints

Array = NDArray[np.float64]
PIXEL = 1 / 280
"""The angle of a pixel of a frame of 480 pixels with a field of view of 80 degrees."""
LOOSE = np.diag(np.square([0.1, 0.1, 0.35, 5, 5, 5]))
KNOWN = np.diag(np.square([0.05, 0.05, 0.01, 0.05, 0.05, 0.3]))


def street(random: np.random.Generator, count: int = 400) -> Array:
    """Points on both sides of a street along x, and on the ground, float64 [count, 3]."""
    x = random.uniform(-5, 60, count)
    y = np.where(random.random(count) < 0.5, 6, -5) + random.normal(0, 1, count)
    return np.column_stack([x, y, random.uniform(-1.5, 5, count)])


def attitude(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Array:
    """By degrees to the left, down and to the right."""
    made = np.eye(3)
    for axis, degrees in enumerate((roll, pitch, yaw)):
        made = np.asarray(cv2.Rodrigues(np.radians(degrees) * np.eye(3)[axis])[0], np.float64) @ made
    return made


def stand(position: tuple[float, float, float], yaw: float = 0.0, covariance: Array = KNOWN) -> Stand:
    return Stand(np.array(position), attitude(yaw), covariance)


def seen(scene: Array, camera: Stand, random: np.random.Generator, pixels: float) -> Array:
    """Optical directions with noise; NaN for points that are not in the picture."""
    x, y, z = ((scene - camera.position) @ camera.attitude @ BODY).T
    ahead = (z > 1) & (np.abs(x) < 0.85 * z) & (np.abs(y) < 0.6 * z)
    image = np.column_stack([x / np.maximum(z, 1), y / np.maximum(z, 1)])
    rays = np.column_stack([image + random.normal(0, pixels * PIXEL, image.shape), np.ones(len(scene))])
    rays[~ahead] = np.nan
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def sightings(
    query: Stand, places: list[Stand], random: np.random.Generator, pixels: float = 0.7, wrong: float = 0.0
) -> list[SharedPoints]:
    """The points that the query shares with each place; a share of the matches is wrong, but for the first place."""
    scene = street(random)
    ours = seen(scene, query, random, pixels)
    made = []
    for at, place in enumerate(places):
        theirs = seen(scene, place, random, pixels)
        both = np.flatnonzero(np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1))
        # Fewer points are matched from farther away.
        kept = both[random.random(len(both)) < 1 / (1 + np.linalg.norm(place.position - query.position) / 4)]
        mixed = np.flatnonzero(random.random(len(kept)) < wrong * (at > 0))
        shown = theirs[kept]
        shown[mixed] = shown[random.permutation(mixed)]
        count = len(kept)
        made.append(SharedPoints(kept, ours[kept], shown, np.ones(count, np.bool_), np.full(count, 0.9), PIXEL))
    return made


def begun(query: Stand, best: Stand, length: float = 0.5) -> Stand:
    """The start: the right attitude and the right direction from the best match, and a wrong length."""
    away = query.position - best.position
    return replace(query, position=best.position + length * away, covariance=LOOSE)


@pytest.mark.thorough
@pytest.mark.parametrize("spacing", [3.0, 8.0, 14.0])
def test_places_on_one_line_tell_how_far_the_query_is(spacing: float) -> None:
    random, normalized, errors = np.random.default_rng(2), [], []
    for _ in range(8):
        query = stand((spacing * 0.4, random.normal(0, 0.1), 0), random.normal(0, 2))
        places = [stand((x, 0, 0)) for x in (0.0, spacing, -spacing)]
        prior = replace(places[0], covariance=LOOSE)
        found = bundle_stand(prior, places, sightings(query, places, random), begun(query, places[0]))
        assert found is not None
        missed = (found.position - query.position)[:2]
        errors.append(np.linalg.norm(missed))
        normalized.append(missed @ np.linalg.solve(found.covariance[3:5, 3:5], missed) / 2)
        assert np.abs(cv2.Rodrigues(found.attitude @ query.attitude.T)[0]).max() < np.radians(1)
    assert np.median(errors) < 0.4 * spacing / 6
    assert 0.1 < np.mean(normalized) < 3


def test_wrong_matches_of_far_places_do_not_pull_the_query_away() -> None:
    random, errors = np.random.default_rng(3), []
    for _ in range(6):
        query = stand((3.0, 0.1, 0), 1.0)
        places = [stand((0, 0, 0)), stand((9, 0.1, 0)), stand((-9, 0, 0))]
        shared = sightings(query, places, random, wrong=0.4)
        found = bundle_stand(replace(places[0], covariance=LOOSE), places, shared, begun(query, places[0], 0.3))
        assert found is not None
        errors.append(np.linalg.norm((found.position - query.position)[:2]))
    assert np.median(errors) < 1


def test_a_place_that_only_looks_alike_is_left_out() -> None:
    random = np.random.default_rng(4)
    query = stand((1.5, 0.3, 0), -3)
    places = [stand((0, 0, 0)), stand((4, 0, 0)), stand((-4, 0, 0))]
    shared = sightings(query, places, random)
    strange = [*places, stand((10, 12, 0), 90)]  # its picture is that of the second place
    found = bundle_stand(replace(places[0], covariance=LOOSE), strange, [*shared, shared[1]], begun(query, places[0]))
    assert found is not None and np.linalg.norm((found.position - query.position)[:2]) < 0.3


def test_headings_that_are_off_make_the_query_less_certain() -> None:
    random, deviations = np.random.default_rng(5), []
    query = stand((1.5, 0.3, 0), -3)
    for off in (0.0, 3.0):
        true = [stand((x, 0, 0), 0) for x in (0.0, 3.0, -3.0)]
        shared = sightings(query, true, random)
        told = [replace(place, attitude=attitude(turn * off)) for place, turn in zip(true, (0, 1, -1), strict=True)]
        found = bundle_stand(replace(told[0], covariance=LOOSE), told, shared, begun(query, told[0]))
        assert found is not None
        deviations.append(found.covariance[2, 2] ** 0.5)
    assert deviations[1] > 3 * deviations[0]


def test_positions_that_are_off_make_the_query_less_certain() -> None:
    """Half a metre aside, ten times the error that is thought usual."""
    normalized = []
    for seed in range(8):
        random = np.random.default_rng(seed)
        query = stand((1.2, 0.2, 0), -3)
        true = [stand((x, 0, 0), 0) for x in (0.0, 3.0, -3.0)]
        shared = sightings(query, true, random)
        told = [replace(one, position=one.position + np.append(random.normal(0, 0.5, 2), 0)) for one in true]
        found = bundle_stand(replace(told[0], covariance=LOOSE), told, shared, begun(query, told[0]))
        if found is not None:
            missed = (found.position - query.position)[:2]
            normalized.append(missed @ np.linalg.solve(found.covariance[3:5, 3:5], missed) / 2)
    assert len(normalized) >= 6 and np.median(normalized) < 3, "it is 7 if they count as right within 5 cm"


def test_nothing_is_told_by_one_place_or_by_few_points() -> None:
    random = np.random.default_rng(6)
    query, places = stand((1, 0, 0)), [stand((0, 0, 0)), stand((3, 0, 0))]
    shared, prior = sightings(query, places, random), replace(places[0], covariance=LOOSE)
    start = begun(query, places[0])
    assert bundle_stand(prior, places[:1], shared[:1], start) is None
    few = replace(shared[1], fitting=np.arange(len(shared[1].numbers)) < 5)
    assert bundle_stand(prior, places, [shared[0], few], start) is None
    none = replace(shared[0], fitting=np.zeros(len(shared[0].numbers), np.bool_))
    assert bundle_stand(prior, places, [none, shared[1]], start) is None


def test_the_normal_equations_are_those_of_the_cost() -> None:
    """Of small residuals the robust cost is the sum of their squares, whose slope is twice the gradient."""
    random = np.random.default_rng(7)
    query, places = stand((1, 0.2, 0.1), 2), [stand((0, 0, 0)), stand((3, 0.1, 0), 1)]
    bearings = random.normal(0, 1, (6, 3)) + np.array([5, 0, 0])
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    point, place = np.tile(np.arange(6), 2), np.repeat([1, 2], 6)
    attitudes = np.array([one.attitude for one in (query, *places)])
    positions = np.array([one.position for one in (query, *places)])
    nearness = random.uniform(0.05, 0.3, 6)
    v = bearings[point] @ query.attitude.T + nearness[point, np.newaxis] * (positions[0] - positions[place])
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    rays = np.array([attitudes[k].T @ one for k, one in zip(place, v, strict=True)])
    rays += random.normal(0, 1e-5, rays.shape)
    stands = [replace(query, covariance=LOOSE), *places]
    bundle = _Bundle(bearings, point, place, rays, np.full(2, 1e-2), stands, np.array([6.0, 6.0]))
    state = _State(attitudes, positions, nearness)
    normal = bundle.normal_equations(state)
    step = 1e-6
    for value in range(18):
        moved = [bundle.cost(state.moved(sign * step * np.eye(18)[value], np.zeros(6))) for sign in (1, -1)]
        assert (moved[0] - moved[1]) / (4 * step) == pytest.approx(normal.poses_gradient[value], rel=1e-2, abs=1e-2)
    for point_number in range(6):
        nearer = step * np.eye(6)[point_number]
        moved = [bundle.cost(state.moved(np.zeros(18), sign * nearer)) for sign in (1, -1)]
        assert (moved[0] - moved[1]) / (4 * step) == pytest.approx(
            normal.nearness_gradient[point_number], rel=1e-2, abs=1e-2
        )
