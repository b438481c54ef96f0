"""Odometry that contradicts what frames show is noticed, does no harm, and is believed again once it agrees."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from core.belief import (
    ContradictionKind,
    Evidence,
    OdometryPose,
    PlaceGraph,
    Run,
    RunOptions,
    Sighting,
    Step,
    freshness,
    from_bytes,
    to_bytes,
)
from core.belief.motion import Odometry
from core.places import GEOGRAPHIC, Neighborhood, Pose, Whereabouts
from tests.core.belief.maps import graph_of, posed, walk

METRES, PLACES = 2.0, 160
SOON = 8
"""Frames within which a fault is noticed; it takes three steps of the map at least, and their noise."""

HEADINGS = 0.8 * np.sin(np.arange(PLACES) * METRES / 30)
POINTS = np.concatenate([[0], np.cumsum(METRES * np.exp(1j * HEADINGS))[:-1]])


@pytest.fixture(scope="module")
def graph() -> PlaceGraph:
    return graph_of(posed([(one.real, one.imag) for one in POINTS]), Neighborhood(5.0, 2))


def seen_at(row: int, random: np.random.Generator, places: int = PLACES, probability: float = 0.85) -> Evidence:
    """A frame that is recognized at a place or beside it, and speaks for those around and for a few others."""
    best = int(np.clip(row + random.choice([-1, 0, 0, 1]), 0, places - 1))
    around = np.clip(np.arange(best - 2, best + 3), 0, places - 1)
    rows, first = np.unique(np.concatenate([around, random.choice(places, 5, replace=False)]), return_index=True)
    gains = np.concatenate([[1.0, 2.0, 3.0, 2.0, 1.0], random.uniform(0.2, 1.0, 5)])[first].astype(np.float32)
    return Evidence(rows.astype(np.int64), gains, 1.0, Sighting(best, probability))


@dataclass(frozen=True)
class Fault:
    """What odometry says of a motion, and of a heading, while it is wrong."""

    length: float = 1.0
    turn: float = 0.0
    heading: Callable[[float], float] = lambda heading: heading


FAULTS: dict[str, tuple[Fault, ContradictionKind, str]] = {
    "frozen": (Fault(length=0.0), "frozen", "odometry stands still while frames show .* m of motion"),
    "short": (Fault(length=0.3), "scale", "odometry goes 0.[23].* m for each metre of the map"),
    "long": (Fault(length=3.0), "scale", "odometry goes [23].* m for each metre of the map"),
    "millimetres": (Fault(length=1000.0), "units", "odometry goes .* m for each metre of the map: millimetres?"),
    "backwards": (Fault(turn=math.pi), "turned", "the headings of odometry are turned by -?1[678].° against the map"),
    "camera axes": (Fault(turn=math.pi / 2), "turned", "the headings of odometry are turned by [89].° against the map"),
    "radians": (Fault(heading=math.radians), "units", "look like radians where degrees are expected"),
}


def poses(
    rows: Iterable[int], fault: Fault = Fault(), wrong: range = range(0), deviation: float | None = None
) -> list[OdometryPose]:
    """Odometry on a way through the map, that begins in a frame of its own, turned by two radians."""
    found: list[OdometryPose] = []
    at, before = 0j, None
    for number, row in enumerate(rows):
        here = complex(POINTS[row])
        at += (fault.length if number in wrong else 1.0) * (0 if before is None else here - before)
        heading = math.remainder(float(HEADINGS[row]) + 2.0, 2 * math.pi)
        heading = fault.heading(heading) + fault.turn if number in wrong else heading
        point, before = at * np.exp(2j), here
        grown = None if deviation is None else np.diag([number * deviation**2] * 2 + [1e-4 * number]).ravel()
        covariance = None if grown is None else tuple(grown.tolist())
        found.append(OdometryPose(float(point.real), float(point.imag), heading, covariance))
    return found


@dataclass(frozen=True)
class Followed:
    """Of each frame: the kind of the contradiction, and whether the robot was recognized rightly or wrongly."""

    kinds: list[ContradictionKind | None]
    notes: list[str | None]
    right: list[bool]
    wrong: list[bool]


def follow(
    graph: PlaceGraph,
    rows: Iterable[int],
    odometry: Iterable[OdometryPose | None],
    reloaded: bool = False,
    seed: int = 5,
) -> Followed:
    random, run = np.random.default_rng(seed), Run(RunOptions(), graph)
    found = Followed([], [], [], [])
    for row, pose in zip(rows, odometry, strict=True):
        if reloaded:
            run = Run.restored(RunOptions(), graph, from_bytes(to_bytes(run.state())))
        motion = None if pose is None else run.moved_to(pose, None, None)
        run.advance(seen_at(row, random, len(graph)), Step(odometry=motion), None, pose)
        told = run.estimate(1, np.ones(len(graph), np.bool_))
        near = abs(int(told.candidates[0].row) - row) <= 2
        found.kinds.append(None if run.contradiction is None else run.contradiction.kind)
        found.notes.append(None if run.contradiction is None else run.contradiction.note)
        found.right.append(told.verdict == "recognized" and near)
        found.wrong.append(told.verdict == "recognized" and not near)
    return found


@pytest.mark.parametrize("deviation", [None, 1.0])
@pytest.mark.parametrize("start", [0, 40])
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_odometry_is_noticed_and_does_no_harm(
    graph: PlaceGraph, name: str, start: int, deviation: float | None
) -> None:
    fault, _, _ = FAULTS[name]
    rows = range(20, 120)
    told = follow(graph, rows, poses(rows, fault, range(start, 100), deviation))
    assert not any(told.kinds[:start]), "as long as it was right"
    soon = 4 * SOON if name == "radians" or deviation else SOON
    assert told.kinds[start + soon], f"within {soon} frames"
    assert sum(map(bool, told.kinds[start + soon :])) >= 0.8 * (100 - start - soon), "and stays so"
    assert sum(told.right) >= 90 and sum(told.wrong) <= 5


@pytest.mark.parametrize("name", FAULTS)
def test_a_contradiction_says_what_odometry_looks_like(graph: PlaceGraph, name: str) -> None:
    fault, kind, note = FAULTS[name]
    rows = range(20, 120)
    told = follow(graph, rows, poses(rows, fault, range(100)))
    said = [one for one in told.kinds if one is not None]
    assert said.count(kind) >= 0.6 * len(said), said
    assert any(re.search(note, one) for one in told.notes if one is not None), set(told.notes)


@pytest.mark.parametrize("name", ["short", "long", "backwards", "camera axes"])
def test_odometry_that_agrees_again_moves_the_belief_again(graph: PlaceGraph, name: str) -> None:
    rows = range(20, 120)
    told = follow(graph, rows, poses(rows, FAULTS[name][0], range(30, 60)))
    assert told.kinds[59] is not None
    assert not any(told.kinds[60 + SOON :]), told.kinds[60:]


def test_a_contradiction_outlives_a_restart(graph: PlaceGraph) -> None:
    rows = range(20, 80)
    odometry = poses(rows, FAULTS["backwards"][0], range(10, 60))
    assert follow(graph, rows, odometry, reloaded=True).kinds == follow(graph, rows, odometry).kinds


@pytest.mark.parametrize("seed", range(5))
def test_odometry_that_slips_drifts_and_turns_a_little_is_believed(graph: PlaceGraph, seed: int) -> None:
    random = np.random.default_rng(seed)
    rows = [*range(10, 80), *[80] * 20, *range(80, 20, -1), *range(20, 100, 3)]  # it stands, goes back, and hurries
    exact, at, turned, odometry = poses(rows), 0j, 0.0, []
    for before, now in zip([exact[0], *exact], exact, strict=False):
        way = complex(now.x - before.x, now.y - before.y)
        at += way * np.exp(1j * turned) * (1.05 + 0.03 * random.normal())
        turned += 0.01 * random.normal()
        odometry.append(OdometryPose(float(at.real), float(at.imag), now.heading + turned))
    assert not any(follow(graph, rows, odometry, seed=seed).kinds)


def test_a_robot_that_is_carried_off_has_odometry_that_is_right(graph: PlaceGraph) -> None:
    rows = [*range(10, 40), *range(110, 150)]
    odometry = [*poses(range(10, 40)), *(replace(one, x=one.x + 50) for one in poses(range(110, 150)))]
    before, after = odometry[29], odometry[30]
    odometry[30:] = [replace(one, x=one.x - after.x + before.x, y=one.y - after.y + before.y) for one in odometry[30:]]
    assert not any(follow(graph, rows, odometry).kinds)


def test_wrong_sightings_now_and_then_are_no_fault_of_odometry(graph: PlaceGraph) -> None:
    rows = list(range(10, 110))
    shown = [(row + 70) % PLACES if number % 9 == 4 else row for number, row in enumerate(rows)]
    assert not any(follow(graph, shown, poses(rows)).kinds)


def test_a_detour_out_of_the_map_is_no_fault_of_odometry(graph: PlaceGraph) -> None:
    rows, random, run = [*range(10, 30), *range(60, 90)], np.random.default_rng(3), Run(RunOptions(), graph)
    way = [*poses(range(10, 90))]
    for number, pose in enumerate(way):
        row = number + 10
        seen = seen_at(row, random)
        seen = seen if row in rows else replace(seen, sighting=None)
        run.advance(seen, Step(odometry=run.moved_to(pose, None, None)), None, pose)
        assert run.contradiction is None


@pytest.mark.parametrize("seed", range(5))
def test_odometry_that_stands_still_by_now_is_frozen_whatever_it_did_before(graph: PlaceGraph, seed: int) -> None:
    rows = range(20, 90)
    told = follow(graph, rows, poses(rows, FAULTS["frozen"][0], range(40, 70)), seed=seed)
    assert set(told.kinds[40:]) == {None, "frozen"}


def test_a_map_without_poses_checks_nothing() -> None:
    graph = graph_of(walk(PLACES), Neighborhood(5.0, 2))
    rows = range(20, 60)
    assert not any(follow(graph, rows, poses(rows, FAULTS["frozen"][0], range(40))).kinds)


def test_a_map_on_the_earth_is_checked_as_well() -> None:
    metres = 360 / 40_030_230
    earthly = [Pose(latitude=60 + one.imag * metres, longitude=170 + one.real * metres / 0.5) for one in POINTS]
    where = Whereabouts.along_sequence(np.arange(PLACES))
    where = replace(
        where,
        kind=np.full(PLACES, GEOGRAPHIC, np.int8),
        position=np.array([one.position() for one in earthly]),
    )
    graph, rows = graph_of(where, Neighborhood(5.0, 2)), range(20, 80)
    assert graph.geographic
    assert not any(follow(graph, rows, poses(rows)).kinds)
    assert follow(graph, rows, poses(rows, FAULTS["frozen"][0], range(60))).kinds[SOON:] == ["frozen"] * (60 - SOON)


def test_numbers_of_any_size_are_compared(graph: PlaceGraph) -> None:
    rows = range(20, 60)
    odometry = [
        replace(one, x=1e6 * one.x, y=-1e6 * one.y, covariance=(1e12 * number, 0, 0, 0, 0, 0, 0, 0, 0))
        for number, one in enumerate(poses(rows))
    ]
    assert len(follow(graph, rows, odometry).kinds) == 40


def test_a_motion_that_is_not_known_well_is_no_proof_that_the_robot_stands() -> None:
    assert freshness(Odometry(0.0), 2.0) == pytest.approx(0.1)
    assert freshness(Odometry(0.0, variance=1.0), 2.0) == 1.0
    assert freshness(Odometry(0.0, turn_variance=1.0), 2.0) == 1.0
    assert 0.1 < freshness(Odometry(0.0, variance=0.05), 2.0) < freshness(Odometry(0.5, variance=0.05), 2.0) < 1
