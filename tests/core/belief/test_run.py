"""A run as a whole: carried off, out of the map, two corridors alike, taken up again."""

from __future__ import annotations

import math
import zlib
from dataclasses import replace

import numpy as np
import pytest

from core.belief import (
    NOTHING,
    DamagedRecord,
    Evidence,
    Odometry,
    PlaceGraph,
    Run,
    RunOptions,
    Sighting,
    Step,
    Stride,
    View,
    from_bytes,
    place_graph,
    to_bytes,
)
from core.belief.run import LOST_AFTER
from core.belief.view import HEIGHT, WIDTH
from core.places import Neighborhood
from tests.core.belief.maps import graph_of, posed, shows, walk

DEFAULT = RunOptions()
NOWHERE = 1.0


def alive(graph: PlaceGraph) -> np.ndarray:
    return np.ones(len(graph.index), np.bool_)


def seen_at(row: int, places: int, random: np.random.Generator) -> Evidence:
    """A frame taken at a row: that speaks for it a little more than for a few others."""
    others = random.choice(places, 6, replace=False)
    others = others[others != row]
    gains = np.append(random.uniform(0.3, 2.2, len(others)), 3.7).astype(np.float32)
    return Evidence(np.append(others, row).astype(np.int64), gains, NOWHERE)


@pytest.mark.thorough
def test_a_robot_is_found_and_found_again_when_carried_off() -> None:
    random, graph = np.random.default_rng(3), graph_of(walk(400), Neighborhood(5, 3))
    run, found = Run(DEFAULT, graph), []
    for row in [*range(50, 80), *range(300, 330)]:
        run.advance(seen_at(row, 400, random), Step())
        told = run.estimate(1, alive(graph))
        found.append(told.verdict == "recognized" and abs(told.candidates[0].row - row) <= 3)
    assert all(found[15:30]), "on the way"
    assert found[30:].index(True) <= 20 and all(found[50:]), "and after it was carried off"


@pytest.mark.thorough
def test_what_is_not_in_the_map_is_unknown_after_a_few_frames() -> None:
    random, graph = np.random.default_rng(4), graph_of(walk(300), Neighborhood(5, 3))
    run = Run(DEFAULT, graph)
    for row in range(100, 125):
        run.advance(seen_at(row, 300, random), Step())
        verdict = run.estimate(1, alive(graph)).verdict
    assert verdict == "recognized" and not run.lost
    verdicts = []
    for _ in range(30):
        rows = random.choice(300, 6, replace=False)
        run.advance(Evidence(rows, random.uniform(0.3, 2.2, 6).astype(np.float32), NOWHERE), Step())
        verdicts.append(run.estimate(1, alive(graph)).verdict)
    assert verdicts[15:] == ["unknown"] * 15
    assert run.lost and run.unrecognized is not None and run.unrecognized >= LOST_AFTER


def test_a_blocked_view_does_not_lose_the_place() -> None:
    random, graph = np.random.default_rng(5), graph_of(walk(300), Neighborhood(5, 3))
    run = Run(DEFAULT, graph)
    for row in range(100, 130):
        run.advance(seen_at(row, 300, random), Step())
    for _ in range(8):  # a bus stands before the camera
        run.advance(NOTHING, Step())
    run.advance(seen_at(138, 300, random), Step())
    told = run.estimate(1, alive(graph))
    assert told.verdict == "recognized" and abs(told.candidates[0].row - 138) <= 3


@pytest.mark.parametrize("stride", [None, Stride()])
def test_a_clock_that_jumps_leaves_a_wide_belief(stride: Stride | None) -> None:
    """The robot may go on where it was, for its clock was set, or be anywhere, for a recording is played again."""
    random, graph = np.random.default_rng(6), graph_of(walk(300), Neighborhood(5, 3))
    found = {}
    for known in (True, False):
        for row in (131, 20):
            run = Run(RunOptions(stride, lag=2), graph)
            for number in range(100, 131):
                run.advance(seen_at(number, 300, random), Step())
            assert run.earlier(1, alive(graph)) is not None
            run.advance(shows(row, gain=3.7, unknown=NOWHERE), Step(known=known))
            assert (run.earlier(1, alive(graph)) is None) == (not known), "the frames before are of another time"
            told = run.estimate(300, alive(graph))
            found[known, row] = sum(one.probability for one in told.candidates if abs(one.row - row) <= 3)
    assert found[False, 131] > 0.5, "where it was"
    assert found[False, 20] > 10 * found[True, 20], "and anywhere else sooner than without a jump"


def test_odometry_tells_two_corridors_apart_that_look_the_same() -> None:
    straight = [(float(i), 0.0) for i in range(20)]
    bent = [(float(min(i, 10)), 50.0 + max(0.0, i - 10.0)) for i in range(20)]
    graph = graph_of(posed(straight, bent))
    told = {}
    for way, turning in (("straight", 0.0), ("bent", math.pi / 2)):
        blind, knowing = Run(DEFAULT, graph), Run(DEFAULT, graph)
        for number in range(2, 18):
            frame = shows(number, 20 + number, gain=1.5, unknown=NOWHERE)
            blind.advance(frame, Step())
            # It looks along the way on: at frame 10 already to the left.
            turn = turning if number == 10 else 0.0
            knowing.advance(frame, Step(odometry=Odometry(1.0, 0.0, turn, 0.01, 0.01)))
        told[way] = knowing.estimate(2, alive(graph))
        assert blind.estimate(2, alive(graph)).verdict == "ambiguous"
    assert told["straight"].verdict == told["bent"].verdict == "recognized"
    assert told["straight"].candidates[0].row < 20 <= told["bent"].candidates[0].row


def test_a_second_look_from_the_same_spot_is_no_second_witness() -> None:
    graph = graph_of(posed([(float(i), 0.0) for i in range(20)]))
    still, moving = (Run(RunOptions(stride=Stride(0.0)), graph) for _ in range(2))
    for _ in range(6):
        still.advance(shows(5, gain=0.5), Step(odometry=Odometry(0.0)))
        moving.advance(shows(5, gain=0.5), Step())
    assert (
        still.look(1, alive(graph)).candidates[0].probability < moving.look(1, alive(graph)).candidates[0].probability
    )


def test_places_that_die_between_two_frames_are_not_reported() -> None:
    graph = graph_of(walk(30))
    run = Run(DEFAULT, graph)
    for number in range(5):
        run.advance(shows(10 + number), Step())
    assert run.look(1, alive(graph)).verdict == "recognized"
    living = alive(graph)
    living[13:16] = False
    told = run.look(5, living)
    assert not {13, 14, 15} & {candidate.row for candidate in told.candidates}
    assert told.verdict == "unknown", "what is left of the belief is that the robot is where no place is any more"
    run.place_on(place_graph(walk(30), np.flatnonzero(living), 30, Neighborhood(1, 1)))
    assert run.look(1, living).verdict == "unknown"
    assert run.look(1, living[:0]).candidates == ()


@pytest.mark.parametrize("start", [0, 5])
def test_a_run_can_be_looked_at_when_places_have_come_or_gone(start: int) -> None:
    run = Run(DEFAULT, graph_of(walk(30)))
    for number in range(5):
        run.advance(shows(10 + number), Step())
    rows = np.arange(start, 40)  # ten new ones at the end, and the first ones gone
    changed = place_graph(walk(40), rows, 40, Neighborhood(1, 1))
    run.place_on(changed)
    assert run.look(1, alive(changed)).candidates[0].row == 14
    run.advance(shows(15), Step())
    assert run.look(1, alive(changed)).candidates[0].row == 15


def test_a_run_is_taken_up_where_it_was() -> None:
    random, graph = np.random.default_rng(6), graph_of(walk(2000), Neighborhood(5, 3))
    run = Run(DEFAULT, graph)
    for row in range(700, 720):
        run.advance(seen_at(row, 2000, random), Step())
        run.estimate(1, alive(graph))
    data = to_bytes(run.state())
    assert len(data) < 16_000
    again = Run.restored(DEFAULT, graph, from_bytes(data))
    assert (again.frames, again.unrecognized) == (run.frames, run.unrecognized)
    for one in (run, again):
        assert one.look(1, alive(graph)).verdict == "recognized"
    np.testing.assert_allclose(again.belief.given, run.belief.given, atol=2e-3)
    following = seen_at(720, 2000, random)
    for one in (run, again):
        one.advance(following, Step())
    np.testing.assert_allclose(again.belief.given, run.belief.given, atol=2e-3)
    assert again.belief.unknown == pytest.approx(run.belief.unknown, abs=1e-4)


def test_a_record_that_was_changed_is_refused() -> None:
    data = to_bytes(Run(DEFAULT, graph_of(walk(10))).state())
    for bad in (b"", data[:7], data[:-1], data[:9] + b"?" + data[10:]):
        with pytest.raises(DamagedRecord):
            from_bytes(bad)


@pytest.mark.parametrize("written", [1, 2, 3, 5])
def test_a_record_of_another_format_is_refused(written: int) -> None:
    data = to_bytes(Run(DEFAULT, graph_of(walk(10))).state())
    rest = data[4:].replace(b'"format":4', f'"format":{written}'.encode())
    with pytest.raises(DamagedRecord, match=f"it is of format {written}, this version of placerec knows 4"):
        from_bytes(zlib.crc32(rest).to_bytes(4, "little") + rest)


def recognized_at(row: int, probability: float = 0.8, *rows: int) -> Evidence:
    """A frame that is recognized by itself, and speaks for a row no more than for others."""
    return replace(shows(row, *rows, gain=0.5, unknown=NOWHERE), sighting=Sighting(row, probability))


def test_a_first_frame_that_is_recognized_by_itself_is_recognized() -> None:
    graph = graph_of(walk(200), Neighborhood(5, 3))
    run = Run(DEFAULT, graph)
    run.advance(recognized_at(90), Step(), view(90))
    told = run.estimate(5, alive(graph))
    assert told.verdict == "recognized" and told.candidates[0].row == 90
    assert told.candidates[0].probability == pytest.approx(0.8)
    again = Run.restored(DEFAULT, graph, from_bytes(to_bytes(run.state())))
    assert again.look(1, alive(graph)).verdict == "recognized", "after a restart, too"
    for _ in range(5):  # it stands there
        run.advance(recognized_at(91), Step(), view(90))
        assert run.sight == "constant" and run.estimate(1, alive(graph)).verdict == "recognized"
    living = alive(graph)
    living[90] = False
    assert run.look(1, living).verdict != "recognized", "the place was deleted meanwhile"
    verdicts = []
    for _ in range(4):
        run.advance(shows(90, gain=0.1, unknown=NOWHERE), Step(), view(90))
        verdicts.append(run.estimate(1, alive(graph)).verdict)
    assert verdicts[0] == "recognized" and verdicts[-1] == "unknown", "its view no longer fits"
    run.advance(NOTHING, Step(), BLACK)
    assert run.estimate(1, alive(graph)).verdict == "unknown"


def test_a_frame_that_is_recognized_elsewhere_makes_a_run_that_is_sure_ambiguous() -> None:
    random, graph = np.random.default_rng(3), graph_of(walk(400), Neighborhood(5, 3))
    run = Run(DEFAULT, graph)
    for row in range(50, 80):
        run.advance(seen_at(row, 400, random), Step(), view(row))
    sure = run.estimate(1, alive(graph))
    assert sure.verdict == "recognized" and sure.candidates[0].row == 79
    run.advance(recognized_at(300, 0.6, 80), Step(), view(300))
    assert run.look(1, alive(graph)).candidates[0].row == 80, "the run is surer than this frame"
    run.advance(recognized_at(301, 0.999, 81), Step(), view(301))
    told = run.look(2, alive(graph))
    assert told.verdict == "ambiguous"
    assert {one.row for one in told.candidates} == {301, 81}


def test_probabilities_of_a_run_add_up_to_one_whatever_a_frame_alone_says() -> None:
    random, graph = np.random.default_rng(8), graph_of(walk(30), Neighborhood(5, 1))
    run = Run(DEFAULT, graph)
    for row in (5, 6, 7, 20, 21):
        run.advance(replace(seen_at(row, 30, random), sighting=Sighting(row, 0.95)), Step(), view(row))
        told = run.estimate(30, alive(graph))
        assert sum(one.probability for one in told.candidates) + told.unknown == pytest.approx(1, abs=2e-2)
        assert [one.probability for one in told.candidates] == sorted(
            (one.probability for one in told.candidates), reverse=True
        )


def test_of_two_places_that_look_the_same_none_is_recognized() -> None:
    graph = graph_of(walk(40, 40))
    run = Run(DEFAULT, graph)
    for row in range(20):
        run.advance(shows(row, 40 + row, gain=6, unknown=-3), Step(), view(row))
        told = run.estimate(1, alive(graph))
        assert told.verdict == "ambiguous" and told.unknown < 0.1


def test_the_place_of_some_frames_ago_is_estimated_better_later() -> None:
    graph = graph_of(walk(40))
    run = Run(RunOptions(lag=3, stride=Stride()), graph)
    verdicts = []
    for rows in ((10, 30), (11, 31), (12,), (13,), (14,)):
        assert run.earlier(1, alive(graph)) is None or run.frames > 3
        run.advance(shows(*rows, gain=2), Step())
        verdicts.append(run.estimate(1, alive(graph)).verdict)
    told = run.earlier(2, alive(graph))
    assert told is not None and told.candidates[0].row in (10, 11, 12)
    assert verdicts[1] == "ambiguous" and told.verdict == "recognized"


def view(number: int) -> View:
    """What the robot sees at a row: unlike what it sees anywhere else."""
    return View(np.random.default_rng(number).integers(0, 256, WIDTH * HEIGHT).astype(np.uint8))


BLACK = View(np.zeros(WIDTH * HEIGHT, np.uint8))


@pytest.mark.parametrize("outside", [False, True])
def test_a_robot_that_was_carried_off_is_missed_within_three_frames(outside: bool) -> None:
    random, graph = np.random.default_rng(7), graph_of(walk(400), Neighborhood(5, 3))
    run = Run(DEFAULT, graph)
    for row in range(50, 80):
        run.advance(seen_at(row, 400, random), Step(), view(row))
    assert run.look(1, alive(graph)).verdict == "recognized"
    for row in range(300, 303):
        frame = shows(*random.choice(400, 6, False), gain=1, unknown=NOWHERE + 0.1)
        run.advance(frame if outside else seen_at(row, 400, random), Step(), view(row))
    told = run.look(1, alive(graph))
    assert told.verdict != "recognized" or abs(told.candidates[0].row - 302) <= 3


@pytest.mark.parametrize("odometry", [None, Odometry(0.0)])
def test_a_robot_that_stands_becomes_no_surer(odometry: Odometry | None) -> None:
    graph = graph_of(posed([(float(i), 0.0) for i in range(60)]))
    once, standing = Run(DEFAULT, graph), Run(DEFAULT, graph)
    for run in (once, standing):
        for row in range(10, 14):
            run.advance(shows(row, row + 30, gain=2), Step(), view(row))
    before = standing.look(1, alive(graph))
    for _ in range(300):
        standing.advance(shows(13, gain=2), Step(odometry=odometry), view(13))
        assert standing.sight == "constant"
    after = standing.look(1, alive(graph))
    assert before.verdict == after.verdict == "ambiguous" and before.candidates[0].row == after.candidates[0].row
    assert after.candidates[0].probability == pytest.approx(before.candidates[0].probability, abs=1e-3)
    for run in (once, standing):
        run.advance(shows(14, gain=2), Step(), view(14))
    assert standing.sight is None
    # A robot that is slow may have advanced a little meanwhile.
    np.testing.assert_allclose(standing.belief.given, once.belief.given, atol=1e-2 if odometry is None else 1e-3)


@pytest.mark.parametrize("stride", [None, Stride()])
def test_a_robot_with_odometry_stands_in_a_map_without_poses(stride: Stride | None) -> None:
    random, graph = np.random.default_rng(9), graph_of(walk(200), Neighborhood(5, 3))
    run = Run(RunOptions(stride), graph)
    for row in range(60):
        run.advance(seen_at(row, 200, random), Step(odometry=Odometry(1.0)), view(row))
    for _ in range(40):
        run.advance(seen_at(59, 200, random), Step(odometry=Odometry(0.0)), view(59))
        told = run.estimate(1, alive(graph))
        assert told.verdict == "recognized" and abs(told.candidates[0].row - 59) <= 1


@pytest.mark.parametrize(
    ("seen", "shown", "sight"),
    [
        (NOTHING, BLACK, "covered"),
        (Evidence(np.array([3]), np.array([0.2], np.float32), NOWHERE), BLACK, "covered"),
        (Evidence(np.array([3]), np.array([0.2], np.float32), NOWHERE), view(129), "constant"),
    ],
)
def test_a_covered_camera_is_unknown_and_says_so(seen: Evidence, shown: View, sight: str) -> None:
    random, graph = np.random.default_rng(5), graph_of(walk(300), Neighborhood(5, 3))
    run = Run(DEFAULT, graph)
    for row in range(100, 130):
        run.advance(seen_at(row, 300, random), Step(), view(row))
    verdicts = []
    for _ in range(30):
        run.advance(seen, Step(), shown)
        assert run.sight == sight
        verdicts.append(run.estimate(1, alive(graph)).verdict)
    assert verdicts[3:] == ["unknown"] * 27 and run.lost
    if sight == "constant":
        run.advance(seen_at(130, 300, random), Step(), view(130))
        assert run.sight is None and run.blind == 0
        told = run.look(1, alive(graph))
        assert told.verdict == "recognized" and abs(told.candidates[0].row - 130) <= 3, "the place was not forgotten"


@pytest.mark.parametrize("motion", [None, Odometry(1.0)])
def test_of_a_robot_that_leaves_the_map_one_answer_is_wrong_at_most(motion: Odometry | None) -> None:
    for seed in range(10):
        random, graph = np.random.default_rng(seed), graph_of(posed([(float(i), 0.0) for i in range(300)]))
        run = Run(DEFAULT, graph)
        for row in range(100, 130):
            run.advance(seen_at(row, 300, random), Step(odometry=motion), view(row))
        assert run.estimate(1, alive(graph)).verdict == "recognized"
        verdicts = []
        for number in range(6):
            outside = Evidence(random.choice(300, 6, False), random.uniform(0.2, 1, 6).astype(np.float32), 1.2)
            run = Run.restored(DEFAULT, graph, from_bytes(to_bytes(run.state())))
            run.advance(outside, Step(odometry=motion), view(number))
            verdicts.append(run.estimate(1, alive(graph)).verdict)
        assert verdicts[1:] == ["unknown"] * 5


def test_people_before_a_robot_that_stands_by_odometry_do_not_drive_it_out_of_the_map() -> None:
    random, graph = np.random.default_rng(5), graph_of(posed([(float(i), 0.0) for i in range(300)]))
    run = Run(DEFAULT, graph)
    for row in range(100, 130):
        run.advance(seen_at(row, 300, random), Step(odometry=Odometry(1.0)), view(row))
    for number in range(5):
        hidden = Evidence(random.choice(300, 6, False), random.uniform(0.2, 1, 6).astype(np.float32), 1.0)
        run.advance(hidden, Step(odometry=Odometry(0.0)), view(number))
        assert run.estimate(1, alive(graph)).verdict == "recognized"


def test_a_view_that_stays_while_odometry_goes_on_is_believed_no_more() -> None:
    graph = graph_of(posed([(float(i), 0.0) for i in range(300)]))
    run = Run(DEFAULT, graph)
    for row in range(100, 120):
        run.advance(recognized_at(row, 0.9), Step(odometry=Odometry(1.0)), view(row))
    verdicts = []
    for _ in range(15):
        run.advance(recognized_at(119, 0.9), Step(odometry=Odometry(1.0)), view(119))
        assert run.sight == "constant"
        verdicts.append(run.estimate(1, alive(graph)).verdict)
    assert verdicts[0] == "recognized" and verdicts[-6:] == ["unknown"] * 6, "it slips, or its camera is stuck"


def test_single_frames_that_do_not_fit_do_not_unsettle_a_robot_that_stands() -> None:
    random, graph = np.random.default_rng(5), graph_of(walk(300), Neighborhood(5, 3))
    run = Run(DEFAULT, graph)
    for row in range(100, 130):
        run.advance(seen_at(row, 300, random), Step(), view(row))
        assert row < 110 or run.estimate(1, alive(graph)).verdict == "recognized"
    for number in range(20):
        run.advance(shows(129, gain=0.2, unknown=NOWHERE) if number % 2 else shows(129), Step(), view(129))
        assert run.sight == "constant" and run.estimate(1, alive(graph)).verdict == "recognized"
    verdicts = []
    for _ in range(4):
        run.advance(shows(129, gain=0.2, unknown=NOWHERE), Step(), view(129))
        verdicts.append(run.estimate(1, alive(graph)).verdict)
    assert verdicts[0] == "recognized" and verdicts[-1] == "unknown"


def test_a_slow_robot_advances_while_its_view_seems_the_same() -> None:
    graph = graph_of(walk(40))
    slow = Run(RunOptions(stride=Stride(0.1)), graph)
    slow.advance(shows(10), Step(), view(0))
    for _ in range(9):
        slow.advance(shows(10), Step(), view(0))
    slow.advance(shows(), Step(), view(1))
    assert slow.belief.given[11] > slow.belief.given[10], "after ten frames it is about one place farther"
