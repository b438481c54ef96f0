"""The frames of a run whose place the rest of it knows, and what a map answers to them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from core.belief import OdometryPose, PlaceGraph
from core.judgement.trials import StagedTrials
from core.learning import PlacedFrame, RunFrame, lesson_of, placed_frames, trials_of
from core.learning.known_frames import MOST_ASKED, STRANGERS
from core.maps import Enrolment, MapSettings
from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoder, Encoding
from core.method.regions import Regions
from core.places import PlaceFields, Pose
from core.store import Directory, Map
from tests.core.learning.runs import covered, except_at, missed, recognized, walked, way
from tests.service.encoders import TWO_STAGES, install_two_stage_encoder

ROWS = list(range(60))
HIDDEN, MISPLACED, COVERED = [10, 11, 25, 26], 30, 40


@pytest.fixture(scope="module")
def graph() -> PlaceGraph:
    return way(80)


def run() -> list[RunFrame]:
    """A run with frames that were missed, one that was mistaken, and a covered one."""

    def frame(row: int, pose: OdometryPose) -> RunFrame:
        if row in HIDDEN:
            return replace(missed(pose), row=row)  # found, though not believed
        if row == COVERED:
            return covered(pose)
        return recognized(70 if row == MISPLACED else row, pose)

    return walked(ROWS, frame)


def test_a_run_places_frames_that_were_missed_or_mistaken(graph: PlaceGraph) -> None:
    frames = run()
    placed = dict(placed_frames(lesson_of(frames, graph), frames))
    assert len(placed) >= 50 and COVERED not in placed
    assert all(row is not None and abs(row - number) <= 2 for number, row in placed.items()), "nothing is off the map"
    assert placed.keys() >= {*HIDDEN, MISPLACED}, "the run knows what no frame was sure of"


def test_a_frame_does_not_prove_itself(graph: PlaceGraph) -> None:
    """However sure of itself the mistaken frame is."""
    frames = run()
    seen = frames[MISPLACED].seen
    frames[MISPLACED] = replace(frames[MISPLACED], seen=replace(seen, gains=10 * seen.gains), probability=0.999)
    row = dict(placed_frames(lesson_of(frames, graph), frames)).get(MISPLACED)
    assert row is None or abs(row - MISPLACED) <= 2


def test_a_run_that_contradicts_itself_places_nothing(graph: PlaceGraph) -> None:
    frames = walked(ROWS, except_at(ROWS[3:]))
    lesson = lesson_of(frames, graph)
    assert lesson.contradiction == "too few recognized"
    assert placed_frames(lesson, frames) == []


def test_frames_off_the_map_are_placed_nowhere(graph: PlaceGraph) -> None:
    """As far as the run is sure that the robot had left it."""
    frames = run()
    lesson = lesson_of(frames, graph)
    away, rows = lesson.away.copy(), lesson.rows.copy()
    away[45:49], rows[45:49] = [0.97, 0.97, 0.97, 0.9], -1
    placed = dict(placed_frames(replace(lesson, away=away, rows=rows), frames))
    assert [number for number, row in placed.items() if row is None] == [45, 46, 47] and 48 not in placed


@pytest.fixture(scope="module")
def encoder(tmp_path_factory: pytest.TempPathFactory) -> Encoder:
    folder = tmp_path_factory.mktemp("models")
    install_two_stage_encoder(folder)
    return EncoderCatalogue(folder).get(TWO_STAGES)


@pytest.fixture
def street(tmp_path: Path, encoder: Encoder) -> Iterator[Map]:
    """Places four metres apart, of which each looks like the next one."""
    atlas = Directory(tmp_path)
    made = atlas.create("street", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    made.enrol(
        [
            Enrolment(
                f"p{number}",
                PlaceFields(pose=Pose(x=4.0 * number, y=0)),
                found.descriptor,
                600,
                number.to_bytes(32, "big"),
                local=found.local,
            )
            for number, found in enumerate(shown(number, encoder) for number in ROWS)
        ]
    )
    yield made
    atlas.close()


NO_REGIONS = Regions(
    np.empty((0, 4), np.int32),
    np.empty(0, np.float32),
    np.empty(0, np.int32),
    np.empty(0, np.int32),
    np.empty((0, 0), np.float32),
)


def shown(place: int, encoder: Encoder, noise: float = 0.0) -> Encoding:
    """What a place of the street shows, and the next one in part."""

    def mixed(shape: tuple[int, ...]) -> NDArray[np.float64]:
        first, second = (np.random.default_rng((at, len(shape))).normal(0, 30, shape) for at in (place, place + 1))
        return first + 0.5 * second + noise * np.random.default_rng((place, 9)).normal(0, 30, shape)

    descriptor = mixed((encoder.dimension,)).astype(np.float32)
    local = np.clip(mixed(encoder.local_shape), -127, 127).astype(np.int8)
    return Encoding(descriptor / np.linalg.norm(descriptor), local, NO_REGIONS, {})


def asked(map_: Map, encoder: Encoder, placed: list[PlacedFrame]) -> StagedTrials:
    frames = [shown(one.number, encoder, 0.5) for one in placed]
    return trials_of(map_, encoder, placed, frames, [None] * len(placed), lambda _done, _total: None)


def test_each_is_asked_and_every_third_without_its_place_too(street: Map, encoder: Encoder) -> None:
    placed = [PlacedFrame(5, 5), PlacedFrame(20, 20), PlacedFrame(40, 12), PlacedFrame(50, 50)]
    trials = asked(street, encoder, placed).two
    assert trials.frame.tolist() == [0, 0, 1, 2, 3, 3]
    assert trials.known.tolist() == [True, False, True, True, True, False]
    assert trials.right.tolist() == [True, False, True, False, True, False], "the run says that it shows another place"
    assert trials.decision[~trials.known].max() < 0.5 * trials.decision[trials.right].min(), (
        "nor its neighbours are there"
    )


def test_strangers_are_asked_once_and_deleted_places_not_at_all(street: Map, encoder: Encoder) -> None:
    street.forget("p20")
    trials = asked(street, encoder, [PlacedFrame(5, 5), PlacedFrame(20, 20), PlacedFrame(63, None)]).two
    assert trials.frame.tolist() == [0, 0, 1] and trials.known.tolist() == [True, False, False]


def test_of_a_long_run_some_frames_are_asked(street: Map, encoder: Encoder) -> None:
    placed = [PlacedFrame(number % 60, number % 60) for number in range(MOST_ASKED + 20)]
    trials = asked(street, encoder, placed).two
    assert len(np.unique(trials.frame)) == MOST_ASKED and len(trials) == MOST_ASKED + MOST_ASKED // STRANGERS
