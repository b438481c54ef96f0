"""The year of runs, and the map in memory: robots are where the plan has them, and looks count from their score on."""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from benchmarks.learning.__main__ import encoded
from benchmarks.learning.living_map import EncodedPicture, LivingMap
from benchmarks.learning.worlds import RobotWorld
from benchmarks.learning.year import ATTACKER, DETOUR, STOOD, RunPlan, curve, moments, year
from core.frames.preprocessing import Pixels
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue

COUNT = 30


def picture(number: int) -> Pixels:
    """A made-up view."""
    random = np.random.default_rng(number)
    return np.asarray(cv2.resize(random.integers(0, 256, (12, 16, 3)).astype(np.uint8), (160, 120)), np.uint8)


@pytest.fixture(scope="module")
def world() -> RobotWorld:
    at = np.arange(COUNT)
    return RobotWorld(
        "made up",
        [picture(number) for number in range(COUNT)],
        lambda number, _condition, _run: picture(number),
        2.0 * at,
        np.abs(at[:, None] - at) <= 2,
        ("day", "night"),
        [picture(1000 + number) for number in range(40)],
    )


def test_a_year_has_every_condition_and_one_attacker(world: RobotWorld) -> None:
    plans = year(world, 12)
    assert {plan.condition for plan in plans} == {"day", "night"}
    assert [plan.robot for plan in plans if ATTACKER in plan.events] == ["stranger"]
    assert {event for plan in plans for event in plan.events} == {ATTACKER, "stands", "detour", "kidnapped"}
    assert len({plan.number for plan in plans}) == len(plans) == 13


def test_odometry_drifts_by_some_percent(world: RobotWorld) -> None:
    lengths = []
    for seed in range(20):
        found = moments(world, RunPlan(0, "day", "A"), seed)
        assert [one.at for one in found] == list(range(COUNT))
        points = [complex(one.pose.x, one.pose.y) for one in found]
        lengths.append(abs(points[-1] - points[0]))
    way, _ = curve(world.metres)
    true = abs(way[-1] - way[0])
    assert 0.01 < float(np.std(lengths)) / true < 0.15
    assert np.mean(lengths) == pytest.approx(true, rel=0.1)


def test_an_attacker_goes_the_same_way_elsewhere(world: RobotWorld) -> None:
    found = moments(world, RunPlan(1000, "day", "stranger", (ATTACKER,)))
    assert len(found) == COUNT
    assert all(one.at is None for one in found)


def test_a_robot_stands_where_it_is(world: RobotWorld) -> None:
    found = moments(world, RunPlan(1, "day", "A", ("stands",)))
    ats = [one.at for one in found]
    (stood,) = {at for at in ats if ats.count(at) > 1}
    assert ats.count(stood) == STOOD + 1
    first = ats.index(stood)
    poses = [found[at].pose for at in range(first, first + STOOD + 1)]
    assert max(math.hypot(one.x - poses[0].x, one.y - poses[0].y) for one in poses) < 1


def test_a_detour_leads_aside_and_back(world: RobotWorld) -> None:
    found = moments(world, RunPlan(2, "day", "A", ("detour",)))
    away = [number for number, one in enumerate(found) if one.at is None]
    assert len(away) == DETOUR
    before = found[away[0] - 1].pose
    far = [math.hypot(found[at].pose.x - before.x, found[at].pose.y - before.y) for at in away]
    assert max(far) > 10
    assert far[-1] < 8


def test_odometry_does_not_notice_a_kidnapping(world: RobotWorld) -> None:
    found = moments(world, RunPlan(4, "day", "A", ("kidnapped",)))
    ats = [one.at or 0 for one in found]
    (cut,) = [at for at in range(1, len(ats)) if ats[at] - ats[at - 1] != 1]
    assert ats[cut] < ats[cut - 1]
    gone = math.hypot(found[cut].pose.x - found[cut - 1].pose.x, found[cut].pose.y - found[cut - 1].pose.y)
    assert gone < 8


@pytest.fixture(scope="module")
def described(world: RobotWorld) -> Iterator[tuple[LivingMap, list[EncodedPicture]]]:
    encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
    frames = encoded(encoder, world.first, keypoints=True)
    points, headings = curve(world.metres)
    yield LivingMap(encoder, frames, np.column_stack([points.real, points.imag]), headings), frames


def test_a_map_in_memory_recognizes_its_frames(described: tuple[LivingMap, list[EncodedPicture]]) -> None:
    map_, frames = described
    answers = map_.recognize(frames)
    assert [one.row for one in answers] == list(range(COUNT))
    assert {one.judgement.verdict for one in answers} == {"recognized"}
    assert len(map_.graph()) == COUNT


def test_a_look_wins_from_its_score_on_and_is_one_place_with_the_first(
    world: RobotWorld, described: tuple[LivingMap, list[EncodedPicture]]
) -> None:
    map_, _ = described
    (stranger,) = encoded(map_.encoder, world.strangers[:1], keypoints=True)
    (before,) = map_.recognize([stranger])
    refused = map_.add_look(7, stranger, np.inf)
    (same,) = map_.recognize([stranger])
    assert (same.row, same.judgement.verdict) == (before.row, before.judgement.verdict)
    map_.withdraw_look(refused)
    taken = map_.add_look(7, stranger, 0.2)
    (after,) = map_.recognize([stranger])
    assert (after.row, after.judgement.verdict) == (taken, "recognized")
    graph = map_.graph()
    assert len(graph) == COUNT
    assert graph.places_at(np.array([7, refused, taken])).tolist() == [7, -1, 7]
    map_.withdraw_look(taken)
    assert len(map_) == COUNT
