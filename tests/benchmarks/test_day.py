"""A short day on the job: what is told of it in the documents, on walks that are drawn."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.day.drive import DriveOutcomes, drive
from benchmarks.day.maps import Change, make_map
from benchmarks.day.odometry import FAULTS
from benchmarks.day.rigs import KINDS, RigAnswer, answers, apart
from benchmarks.day.robots import Asking, Mode, Verify
from benchmarks.day.situations import SITUATIONS, Moment, moments
from benchmarks.day.walks import WalkPair, drawn
from placerec_client import Client
from tests.service.server import Server

SHORT = 0.35
"""Of the seconds of a situation."""


@pytest.fixture(scope="module")
def walk() -> WalkPair:
    return drawn()


class Day:
    """A real service with the maps of the drawn walk, and robots in it."""

    def __init__(self, folder: Path, walk: WalkPair) -> None:
        self._folder, self._walk, self._made = folder, walk, set[Change]()
        self.server = Server(folder).wait()

    def restart(self) -> None:
        port = self.server.reservation.dup()
        assert self.server.stop() == 0
        self.server = Server(self._folder, reservation=port).wait()

    def _make(self, client: Client, change: Change) -> None:
        if change not in self._made:
            self._made.add(change)
            make_map(client, change, self._walk, change, "small", ())

    def rigs(self, kind: str, numbers: range) -> list[tuple[frozenset[int], RigAnswer, list[RigAnswer]]]:
        """The answers to rigs of one kind at some frames of the walk."""
        with Client(str(self.server.client.base_url)) as client:
            self._make(client, "plain")
            return list(answers(client, "plain", self._walk, kind, "auto", numbers))

    def drive(self, asking: Asking, situation: str, verify: Verify = "auto", seconds: float = SHORT) -> DriveOutcomes:
        """What becomes of a robot in a situation."""
        url, change = str(self.server.client.base_url), SITUATIONS[situation].map
        with Client(url) as client:
            self._make(client, change)
        way = moments(SITUATIONS[situation], self._walk, seconds)
        return drive(url, change, Mode(asking, verify, "small"), way, self.restart)


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory, walk: WalkPair) -> Iterator[Day]:
    made = Day(tmp_path_factory.mktemp("day"), walk)
    yield made
    assert made.server.stop() == 0


@pytest.mark.thorough
@pytest.mark.parametrize("asking", ["session", "enrol"])
def test_a_robot_that_stands_where_it_was_mapped_is_recognized(day: Day, asking: Asking) -> None:
    told = day.drive(asking, "standing on a mapped view")
    assert told.count("right") == len(told.outcomes)


@pytest.mark.thorough
@pytest.mark.parametrize("asking", ["session", "odometry"])
def test_answers_that_are_lost_confuse_nobody(day: Day, asking: Asking) -> None:
    told = day.drive(asking, "answers lost")
    assert told.count("silent") > 0
    assert told.count("right") + told.count("silent") == len(told.outcomes)
    assert told.again == 0


@pytest.mark.thorough
@pytest.mark.parametrize("asking", ["single", "session"])
def test_a_map_enrolled_twice_is_the_same_place(day: Day, asking: Asking) -> None:
    told = day.drive(asking, "map enrolled twice")
    assert told.count("right") + told.count("ambiguous") == len(told.outcomes)
    assert told.count("right") > 0


@pytest.mark.thorough
def test_a_camera_upside_down_that_says_so_sees_what_one_upright_sees(day: Day) -> None:
    upright = day.drive("single", "passing", "always")
    turned = day.drive("single", "upside down, with EXIF", "always")
    both = min(len(upright.outcomes), len(turned.outcomes))
    assert turned.outcomes[:both] == upright.outcomes[:both] == ("right",) * both


@pytest.mark.thorough
@pytest.mark.parametrize("asking", ["single", "session"])
def test_nothing_is_recognized_wrongly_while_a_hand_covers_the_camera(day: Day, asking: Asking) -> None:
    told = day.drive(asking, "hand over the camera")
    assert told.count("wrong") == 0
    assert told.count("unknown") + told.count("ambiguous") > 0
    assert told.again == 0


@pytest.mark.thorough
def test_a_session_goes_on_after_a_restart(day: Day) -> None:
    told = day.drive("odometry", "restart")
    assert told.again == 0
    assert told.count("right") == len(told.outcomes)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_a_second_camera_takes_nothing_away_and_hides_no_contradiction(day: Day, walk: WalkPair, kind: str) -> None:
    found = day.rigs(kind, range(2, 20, 5))
    if kind == "contradicting":
        found = [one for one in found if apart(*one[2])]
        assert {answer.verdict for _, answer, _ in found} == {"ambiguous"}
        assert all({one.shown for one in alone} <= answer.named for _, answer, alone in found)
        assert all((answer.probability or 0) <= 0.5 for _, answer, _ in found)
        return
    singly = [[one.outcome(right) == "right" for one in alone] for right, _, alone in found]
    assert sum(answer.outcome(right) == "right" for right, answer, _ in found) >= max(np.sum(singly, axis=0)) > 0
    if kind != "honest":
        both = [(answer, alone[0]) for _, answer, alone in found]
        assert [one.verdict for one, _ in both] == [one.verdict for _, one in both]
        assert [one.probability for one, _ in both] == pytest.approx([one.probability for _, one in both])


@pytest.mark.thorough
@pytest.mark.parametrize("fault", FAULTS)
def test_odometry_that_is_wrong_does_no_harm(day: Day, fault: str) -> None:
    alone, led = (day.drive(asking, f"odometry {fault}", seconds=0.6) for asking in ("single", "odometry"))
    assert led.count("right") >= 0.7 * alone.count("right"), "a few frames must show first that it is wrong"
    assert led.outcomes[-6:] == alone.outcomes[-6:]


@pytest.mark.thorough
@pytest.mark.parametrize("name", SITUATIONS)
def test_a_situation_is_the_same_each_time(walk: WalkPair, name: str) -> None:
    first, second = (list(moments(SITUATIONS[name], walk, 0.1)) for _ in range(2))
    assert first == second
    seconds = [moment.second for moment in first]
    assert len(first) > 1
    assert np.allclose(np.diff(seconds), 1 / SITUATIONS[name].rate)
    assert all(bool(moment.right) == (moment.aside == 0) for moment in first)


def _ways(way: list[Moment]) -> tuple[np.ndarray, np.ndarray]:
    """How far each frame is from the one before, in truth and by the wheels, in metres."""
    truth = np.array([[moment.pose.x, moment.pose.y] for moment in way])
    wheels = np.array([[moment.wheels.x, moment.wheels.y] for moment in way])
    return tuple(np.linalg.norm(np.diff(one, axis=0), axis=1) for one in (truth, wheels))


@pytest.mark.parametrize("name", ["passing", "reverse", "stop and go", "leaving and coming back", "pace 0.3"])
def test_wheels_measure_how_far_a_robot_goes(walk: WalkPair, name: str) -> None:
    truth, wheels = _ways(list(moments(SITUATIONS[name], walk)))
    assert np.allclose(wheels, truth, rtol=0.1)


def test_wheels_do_not_notice_that_a_robot_is_carried(walk: WalkPair) -> None:
    truth, wheels = _ways(list(moments(SITUATIONS["carried off"], walk, SHORT)))
    assert truth.max() > 10
    assert wheels[truth.argmax()] == 0
