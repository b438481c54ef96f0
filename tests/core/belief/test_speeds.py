"""A robot whose speed nobody tells: it is followed at any, and the loop agrees with plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from core.belief import Evidence, PlaceGraph, Run, RunOptions, Step, from_bytes, to_bytes
from core.belief.filter import Belief, contradicted, predicted_by_speed, uninformed
from core.belief.speeds import (
    KEEPING,
    PRIOR,
    SPEEDS,
    UNKNOWN,
    Speeds,
    displacement_of,
    forward,
    kernel_of,
    mixture,
    plausible,
)
from core.belief.view import HEIGHT, WIDTH, View
from core.places import Neighborhood
from tests.core.belief.maps import graph_of, walk
from tests.core.belief.test_run import alive, view

DEFAULT = RunOptions()
PLACES = 400


def seen_at(row: int, random: np.random.Generator) -> Evidence:
    """A frame that speaks for a place, for those beside it nearly as much, and for many others by chance.

    One in four speaks for wrong places alone.
    """
    others = random.choice(PLACES, 20, replace=False)
    gains = dict(zip(others.tolist(), random.uniform(0.2, 1.8, len(others)).tolist(), strict=True))
    if random.random() > 0.25:
        beside = {row + offset: 2.6 - 0.5 * abs(offset) for offset in range(-2, 3) if 0 <= row + offset < PLACES}
        gains |= {at: gain + float(random.normal(0, 0.3)) for at, gain in beside.items()}
    return Evidence(np.array([*gains]), np.array([*gains.values()], np.float32), 1.1)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("advance", "frames"),
    [(10.0, 37), (3.0, 100), (1.0, 80), (0.3, 80), (0.1, 80), (0.0, 60), (-0.3, 80), (-1.0, 100), (-3.0, 100)],
)
def test_a_robot_is_followed_at_any_speed(advance: float, frames: int) -> None:
    random, graph = np.random.default_rng(2), graph_of(walk(PLACES), Neighborhood(5, 3))
    run, right, wrong = Run(DEFAULT, graph), 0, 0
    start = 20 if advance >= 0 else 380
    for number in range(frames):
        row = round(start + advance * number)
        run.advance(seen_at(row, random), Step())
        told = run.estimate(1, alive(graph))
        here = told.verdict == "recognized" and abs(told.candidates[0].row - row) <= 5
        right += here
        wrong += told.verdict == "recognized" and not here
    assert right >= 0.75 * frames and wrong <= 0.03 * frames
    learnt = float(run.belief.speeds.overall(run.belief.given) @ np.array(SPEEDS))
    assert abs(learnt - advance) <= 0.3 + 0.3 * abs(advance), "speeds between 0 and 0.3 are hard to tell apart"


@pytest.mark.thorough
def test_a_robot_that_stops_turns_round_and_goes_on_is_followed() -> None:
    random, graph = np.random.default_rng(3), graph_of(walk(PLACES), Neighborhood(5, 3))
    way = [*range(50, 110), *[110] * 60, *range(110, 60, -1), *[60] * 20, *range(60, 360, 3)]
    run, off = Run(DEFAULT, graph), []
    for row in way:
        run.advance(seen_at(row, random), Step())
        told = run.estimate(1, alive(graph))
        off.append(told.verdict != "recognized" or abs(told.candidates[0].row - row) > 5)
    # Nothing is recognized by itself here, so frames that do not fit make a run doubt that it is in the map.
    assert sum(off) <= 0.22 * len(way)


def test_the_loop_agrees_with_plain_numpy() -> None:
    random, graph = np.random.default_rng(1), graph_of(walk(30, 2, 20))
    masses = random.dirichlet(np.ones(52)).astype(np.float32)
    places = random.choice(52, 40, replace=False).astype(np.int32)
    shares = random.dirichlet(np.ones(len(SPEEDS)), 40).astype(np.float32)
    for frames, constant in ((1, 0), (3, 0), (1, 4)):
        own = np.tile(PRIOR.astype(np.float64), (52, 1))
        own[places] = shares
        moved = np.zeros((52, len(SPEEDS)))
        for place in range(52):
            for number, speed in enumerate(SPEEDS):
                for offset, weight in zip(*kernel_of(displacement_of(speed, frames, constant)), strict=True):
                    to = int(np.clip(place + offset, graph.first[place], graph.last[place] - 1))
                    moved[to, number] += masses[place] * own[place, number] * weight
        change = np.zeros((len(SPEEDS), len(SPEEDS)))
        for number in range(len(SPEEDS)):
            beside = [one for one in (number - 1, number + 1) if 0 <= one < len(SPEEDS)]
            change[number, number] = KEEPING
            change[number, beside] += 0.5 * (1 - KEEPING) / len(beside)
            change[number] += 0.5 * (1 - KEEPING) * PRIOR
        reached, found, rest = forward(masses, Speeds(places, shares, PRIOR), graph, 0.0, frames, constant)
        assert rest == 0 and sorted(reached.tolist()) == list(range(52))
        np.testing.assert_allclose(found, (moved @ change)[reached], atol=1e-6)


def test_few_places_of_a_large_map_are_moved() -> None:
    graph = graph_of(walk(50_000))
    masses = np.full(50_000, 0.5 / 50_000, np.float32)
    masses[[7, 20_000, 20_001]] += np.float32(0.5 / 3)
    reached, found, rest = forward(masses, UNKNOWN, graph, 0.6 / 50_000)
    assert len(reached) < 100 and rest == pytest.approx(0.5, abs=1e-3)
    assert len(set(reached.tolist())) == len(reached) and found.sum() == pytest.approx(0.5, abs=1e-3)
    belief = uninformed(50_000)
    for _ in range(3):
        belief = predicted_by_speed(belief, graph)
    assert belief.given.sum(dtype=np.float64) == pytest.approx(1, abs=1e-3)


def test_the_speed_is_known_after_a_restart() -> None:
    random, graph = np.random.default_rng(5), graph_of(walk(PLACES), Neighborhood(5, 3))
    run = Run(DEFAULT, graph)
    for row in range(380, 300, -1):
        run.advance(seen_at(row, random), Step(), view(row))
    again = Run.restored(DEFAULT, graph, from_bytes(to_bytes(run.state())))
    before, after = (one.belief.speeds.overall(one.belief.given) for one in (run, again))
    assert SPEEDS[int(before.argmax())] == -1
    np.testing.assert_allclose(after, before, atol=0.02)


def test_the_speeds_of_places_that_stay_are_kept_when_others_come_or_go() -> None:
    random = np.random.default_rng(6)
    graph: PlaceGraph = graph_of(walk(PLACES), Neighborhood(5, 3))
    run = Run(DEFAULT, graph)
    for row in range(380, 300, -1):
        run.advance(seen_at(row, random), Step())
    run.place_on(graph_of(walk(PLACES + 10), Neighborhood(5, 3)))
    assert SPEEDS[int(run.belief.speeds.overall(run.belief.given).argmax())] == -1


def test_a_view_that_has_changed_much_speaks_against_slow_speeds_alone() -> None:
    speeds = np.abs(SPEEDS)
    order = np.argsort(speeds)
    for change in (0.12, 0.3, 0.6, 1.0, 1.4, 2.0):
        found = plausible(change, 1, 0)
        assert (found[speeds >= 1] == 1).all() and (found > 0.2).all() and (np.diff(found[order]) >= 0).all()
    assert (plausible(0.12, 1, 0) == 1).all() and plausible(1.0, 1, 0)[SPEEDS.index(0.3)] < 0.5
    assert plausible(1.0, 20, 0)[SPEEDS.index(0.1)] == 1, "twenty frames at a tenth of the pace"


def test_what_speaks_against_a_speed_speaks_against_the_places_where_the_robot_would_have_it() -> None:
    random = np.random.default_rng(8)
    given = random.dirichlet(np.ones(30)).astype(np.float32)
    places = random.choice(30, 12, replace=False).astype(np.int32)
    speeds = Speeds(places, random.dirichlet(np.ones(len(SPEEDS)), 12).astype(np.float32), PRIOR)
    factors = random.uniform(0.3, 1, len(SPEEDS)).astype(np.float32)
    joint = given[:, np.newaxis] * speeds.at(np.arange(30)) * factors
    joint /= joint.sum()
    found = contradicted(Belief(given, 0.2, 0.01, speeds), factors)
    np.testing.assert_allclose(found.given, joint.sum(axis=1), atol=1e-6)
    np.testing.assert_allclose(found.given[:, np.newaxis] * found.speeds.at(np.arange(30)), joint, atol=1e-6)
    assert found.unknown == 0.2


def test_a_place_that_resembles_every_frame_is_not_taken_for_one_where_a_moving_robot_stands() -> None:
    random, graph = np.random.default_rng(9), graph_of(walk(PLACES), Neighborhood(5, 3))
    grey, views = random.normal(0, 1, WIDTH * HEIGHT), []
    for _ in range(40):  # each has a correlation of 0.6 with the last
        grey = 0.6 * grey + 0.8 * random.normal(0, 1, WIDTH * HEIGHT)
        views.append(View(np.clip(128 + 40 * grey, 0, 255).astype(np.uint8)))
    believed = []
    for shown in (views, [None] * 40):
        run = Run(DEFAULT, graph)
        for number, view_shown in enumerate(shown):
            gains = {300: 1.5} | ({100 + number: 3.0} if number % 3 == 0 else {})
            seen = Evidence(np.array([*gains]), np.array([*gains.values()], np.float32), 1.1)
            run.advance(seen, Step(), view_shown)
        slow = float(run.belief.speeds.overall(run.belief.given)[np.abs(SPEEDS) < 1].sum())
        believed.append((slow, float(run.belief.given[300]), float(run.belief.given[139])))
    slow, there, here = believed[0]
    assert slow < 0.1 and here > 0.8 > 0.1 > there
    assert believed[1][0] > 0.9, "or the views would not matter"


def test_constant_frames_let_a_slow_robot_advance_but_not_beyond_the_next_place() -> None:
    assert displacement_of(0.1, 1, 4) == pytest.approx(0.5) and displacement_of(-0.1, 1, 50) == -1
    assert displacement_of(3.0, 1, 50) == 3 and displacement_of(0.0, 1, 50) == 0
    assert displacement_of(0.3, 5, 0) == pytest.approx(1.5)
    offsets, weights = mixture(PRIOR)
    assert weights.sum() == pytest.approx(1) and offsets.min() < -10 < 10 < offsets.max()
