"""Storeys in a run: a belief stays on its own, a statement weighs it once, and a lift takes it to another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.belief import Evidence, Run, RunOptions, Step
from core.belief.graph import PlaceGraph
from core.belief.record import from_bytes, to_bytes
from core.belief.storeys import UNSTATED, Storey, later
from core.places import NO_LEVEL, Neighborhood
from tests.core.belief.maps import graph_of, posed

LENGTH = 12
CORRIDOR = [(float(x), 0.0) for x in range(LENGTH)]


def building(known: str) -> PlaceGraph:
    """Two equal corridors, one above the other; with levels 1 and 2, heights of 0 and 4 metres, or both."""
    where, storey = posed(CORRIDOR, CORRIDOR), np.repeat([0, 1], LENGTH)
    if known != "heights":
        where = replace(where, level=(1 + storey).astype(np.int32))
    if known != "levels":
        where.position[:, 2] = 4.0 * storey
        where = replace(where, height=4.0 * storey)
    return graph_of(where, Neighborhood(1.0, 1))


def twins(x: int, ahead: float = 0.4) -> Evidence:
    """A frame at x, which fits the upper corridor a little better although it may as well show the lower one."""
    rows = np.array([x, LENGTH + x])
    return Evidence(rows, np.array([3.0, 3.0 + ahead], np.float32), 0.5, storeys=rows)


def shares(run: Run) -> tuple[float, float]:
    """How probable the two storeys are, by the summary."""
    masses = run._now().given
    return float(masses[:LENGTH].sum()), float(masses[LENGTH:].sum())


def test_frames_that_show_twins_do_not_add_up_to_a_storey() -> None:
    run = Run(RunOptions(), building("heights"))
    for x in range(LENGTH):
        run.advance(twins(x), Step(reach=1.0))
        assert shares(run) == pytest.approx((0.5, 0.5), abs=1e-3)
    assert run._now().given[[LENGTH - 1, 2 * LENGTH - 1]].sum() > 0.9, "where it is along the corridor is known"
    assert run.look(5, np.ones(2 * LENGTH, np.bool_)).verdict == "ambiguous"


def test_a_frame_that_tells_the_storeys_apart_decides_and_the_run_stays_there() -> None:
    run = Run(RunOptions(), building("heights"))
    run.advance(Evidence(np.array([0]), np.array([6.0], np.float32), 0.5), Step())
    for x in range(1, LENGTH):
        run.advance(twins(x), Step(reach=1.0))
    assert shares(run)[0] > 0.9


def test_a_statement_counts_once_and_gives_way_to_evidence() -> None:
    run = Run(RunOptions(), building("levels"))
    for x in range(6):
        run.advance(twins(x), Step(reach=1.0), storey=Storey(1))
    assert shares(run)[0] == pytest.approx(10 / 11, abs=0.01)
    for x in range(6, LENGTH):
        seen = Evidence(np.array([LENGTH + x]), np.array([3.0], np.float32), 0.5)
        run.advance(seen, Step(reach=1.0), storey=Storey(1))
    assert shares(run)[1] > 0.9, "frames that fit another level say more than what is stated"


@pytest.mark.parametrize("known", ["levels", "both"])
def test_another_statement_is_a_lift(known: str) -> None:
    run = Run(RunOptions(), building(known))
    for x in range(6):
        run.advance(twins(x), Step(reach=1.0), storey=Storey(1))
    run.advance(twins(6), Step(reach=1.0), storey=Storey(2))
    assert shares(run)[1] > 0.95
    run.advance(twins(7), Step(reach=1.0))
    assert shares(run)[1] > 0.95, "what was stated holds on"
    restored = Run.restored(RunOptions(), run.graph, from_bytes(to_bytes(run.state())))
    assert restored.storey == run.storey == Storey(2)


@pytest.mark.parametrize("known", ["levels", "heights", "both"])
def test_a_leap_of_the_height_is_a_lift(known: str) -> None:
    run = Run(RunOptions(), building(known))
    for x in range(6):
        run.advance(twins(x), Step(reach=1.0), storey=Storey(1 if known != "heights" else NO_LEVEL, 250.0 + 0.1 * x))
    before = shares(run)
    run.advance(twins(6), Step(reach=1.0), storey=Storey(height=254.5))
    assert shares(run)[1] > 0.85, "from the upper storey it could not have gone up" if before[0] < 0.6 else before


LIFT = (0.4, 1.2, 2.0, 2.8, 3.6, 4.0, 4.0, 4.0)
STAIRS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.0)
STEEP = (2.0, 4.0, 4.0)


@pytest.mark.parametrize("way", [LIFT, STAIRS, STEEP])
@pytest.mark.parametrize("known", ["heights", "both"])
def test_a_climb_of_several_frames_ends_on_the_storey_that_it_leads_to(known: str, way: tuple[float, ...]) -> None:
    run = Run(RunOptions(), building(known))
    run.advance(Evidence(np.array([0]), np.array([6.0], np.float32), 0.5), Step(), storey=Storey(height=250.0))
    for x in range(1, 4):
        run.advance(twins(x), Step(reach=1.0), storey=Storey(height=250.0))
    assert shares(run)[0] > 0.9
    for height in way:
        run.advance(twins(4, 0.0), Step(reach=0.1), storey=Storey(height=250.0 + height))
    assert shares(run)[1] > 0.85
    for height in (2.0, 0.5, 0.0, 0.0):
        run.advance(twins(4, 0.0), Step(reach=0.1), storey=Storey(height=250.0 + height))
    assert shares(run)[0] > 0.85


def test_a_barometer_that_drifts_is_no_lift_and_a_level_that_the_map_lacks_says_nothing() -> None:
    run = Run(RunOptions(), building("both"))
    run.advance(Evidence(np.array([0]), np.array([6.0], np.float32), 0.5), Step(), storey=Storey(height=250.0))
    for number in range(60):
        run.advance(twins(1, 0.0), Step(reach=0.1), storey=Storey(77, 250.0 + 0.05 * number))
    assert shares(run)[0] > 0.8 and run.storey.level == NO_LEVEL


def test_what_is_stated_of_a_storey() -> None:
    assert later(UNSTATED, Storey(3, 10.0), 1.5) == (Storey(3, 10.0), None)
    assert later(Storey(3, 10.0), UNSTATED, 1.5) == (Storey(3, 10.0), None)
    assert later(Storey(3, 10.0), Storey(3, 11.4), 1.5) == (Storey(3, 10.14), None), "a barometer drifts"
    assert later(Storey(3, 10.0), Storey(height=14.0), 1.5) == (Storey(NO_LEVEL, 10.0), 4.0)
    assert later(Storey(3, 10.0, 14.0), Storey(height=14.05), 1.5)[0] == Storey(NO_LEVEL, 14.05), "it has arrived"
    changed, climb = later(Storey(3, 10.0), Storey(4, 10.5), 1.5)
    assert changed == Storey(4, 10.5) and climb is not None and np.isnan(climb)
    assert later(UNSTATED, Storey(4), 1.5)[1] is None, "the first statement is no lift"
