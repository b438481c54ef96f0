"""A robot that stood still while mapping, on a real map with a real encoder."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from core.belief import Run, RunOptions, Step, evidence_of, place_graph
from core.frames.preprocessing import Pixels
from core.judgement.verdict import Calibration
from core.maps import Enrolment, MapSettings
from core.method.encoder import Encoder, Encoding
from core.places import PlaceFields, Pose
from core.recognition.question import Query, Question
from core.recognition.recognition import Answer, locate
from core.recognition.stages import neighborhood_of
from core.store import Directory, Map
from core.upkeep.redundancy import neighbour_pairs, stops
from tests.service.scenes import scene

PLACES, SPOT, LOOKS = 12, 5, 120
"""More looks than the second stage examines, screens and a compact search finds."""


CALIBRATION = Calibration(
    source="encoder-default", threshold=0.5, margin=0.05, background_mean=0.1, background_deviation=0.05
)
"""Of the scenes by the little encoder of the tests."""


def noisy(pixels: Pixels, seed: int) -> Pixels:
    random = np.random.default_rng(seed)
    light = np.clip(pixels * random.uniform(0.95, 1.05) + random.normal(0, 3, pixels.shape), 0, 255)
    _, data = cv2.imencode(".jpg", light.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 75])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


@pytest.fixture(scope="module")
def walk(encoder: Encoder) -> list[Encoding]:
    """Of each place."""
    return [encoder.encode(scene(seed)) for seed in range(PLACES)]


@pytest.fixture(scope="module")
def looks(encoder: Encoder) -> list[Encoding]:
    """At the spot."""
    return [encoder.encode(noisy(scene(SPOT), seed)) for seed in range(LOOKS)]


@pytest.fixture
def atlas(tmp_path: Path) -> Iterator[Directory]:
    opened = Directory(tmp_path)
    yield opened
    opened.close()


def enrolled(
    atlas: Directory, encoder: Encoder, frames: Sequence[tuple[str, Encoding]], poses: Sequence[float] | None = None
) -> Map:
    """A map of frames in their order; a name is that of a place, a dot and the number of the frame."""
    made = atlas.create("stood", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    made.enrol([
        Enrolment(
            id=name,
            fields=PlaceFields(sequence="walk", pose=None if poses is None else Pose(x=poses[number], y=0)),
            descriptor=encoding.descriptor,
            local=encoding.local,
            regions=len(encoding.regions),
            digest=hashlib.sha256(name.encode()).digest(),
            thumbnail=None,
            image=None,
        )
        for number, (name, encoding) in enumerate(frames)
    ])  # fmt: skip
    made.edit({"calibration": CALIBRATION})
    return made


def with_stop(walk: Sequence[Encoding], looks: Sequence[Encoding]) -> list[tuple[str, Encoding]]:
    return [
        (f"{place}.{number}", shown)
        for place, one in enumerate(walk)
        for number, shown in enumerate(looks if place == SPOT else [one])
    ]


def ask(map_: Map, encoder: Encoder, encoding: Encoding) -> Answer:
    (answer,) = locate(map_, encoder, [Query(encoding, Question(k=1))])
    return answer


def place_of(answer: Answer) -> str | None:
    return None if answer.place is None else answer.place.id.partition(".")[0]


@pytest.mark.thorough
@pytest.mark.parametrize("count", [1, 5, 20, LOOKS])
def test_a_stop_is_recognized_however_long_it_was(
    atlas: Directory, encoder: Encoder, walk: list[Encoding], looks: list[Encoding], count: int
) -> None:
    map_ = enrolled(atlas, encoder, with_stop(walk, looks[:count]))
    assert map_.snapshot().whereabouts.ordinal.max() == PLACES - 1
    answer = ask(map_, encoder, encoder.encode(noisy(scene(SPOT), 1000)))
    assert place_of(answer) == str(SPOT)
    for place in (0, SPOT - 4, SPOT + 4):
        assert place_of(ask(map_, encoder, walk[place])) == str(place)


@pytest.mark.thorough
def test_several_stops_hide_none_of_the_other_places(atlas: Directory, encoder: Encoder, walk: list[Encoding]) -> None:
    """Their looks are more than a compact search finds; a verdict needs the others, and a session the neighbours."""
    spots = (1, 5, 9, 10, 11)
    looks = {spot: [walk[spot]] * LOOKS for spot in spots}
    frames = [
        (f"{place}.{number}", shown)
        for place, one in enumerate(walk)
        for number, shown in enumerate(looks.get(place, [one]))
    ]
    map_ = enrolled(atlas, encoder, frames)
    assert map_.snapshot() and map_.index_status().tier == "compact"
    answer = ask(map_, encoder, encoder.encode(noisy(scene(SPOT), 1000)))
    assert place_of(answer) == str(SPOT)
    assert set(answer.candidates.whereabouts.ordinal.tolist()) == set(range(PLACES))


@pytest.mark.thorough
@pytest.mark.parametrize("apart", [20.0, 400.0])
def test_equal_doors_one_after_the_other_are_rivals(atlas: Directory, encoder: Encoder, apart: float) -> None:
    """Where the second stage does not examine all frames, either."""
    count = encoder.candidates + 60
    frames = [(f"{n}.0", encoder.encode(scene(n))) for n in range(count)]
    frames += [(f"{count}.{n}", encoder.encode(noisy(scene(5000), n))) for n in range(2)]
    poses = [20.0 * n for n in range(count)] + [20.0 * count, 20.0 * count + apart]
    map_ = enrolled(atlas, encoder, frames, poses)
    assert ask(map_, encoder, encoder.encode(noisy(scene(5000), 7))).judgement.verdict == "ambiguous"


@pytest.mark.thorough
def test_a_stop_is_one_place_of_a_session(
    atlas: Directory, encoder: Encoder, walk: list[Encoding], looks: list[Encoding]
) -> None:
    map_ = enrolled(atlas, encoder, with_stop(walk, looks[:40]))
    snapshot, neighborhood = map_.snapshot(), neighborhood_of(map_)
    graph = place_graph(snapshot.whereabouts, map_.scope().living_rows(), snapshot.rows, neighborhood)
    assert len(graph) == PLACES
    run = Run(RunOptions(), graph)
    for encoding in walk:
        run.advance(evidence_of(ask(map_, encoder, encoding), neighborhood), Step())
    found = run.estimate(1, snapshot.alive)
    (place,) = map_.places_at([found.candidates[0].row])
    assert found.verdict == "recognized" and place is not None
    assert int(place.id.partition(".")[0]) >= PLACES - 1 - neighborhood.frames


def test_one_picture_at_two_places_stays_ambiguous(
    atlas: Directory, encoder: Encoder, walk: list[Encoding], looks: list[Encoding]
) -> None:
    frames = [(f"{number}.0", one) for number, one in enumerate([*walk, looks[0]])]
    assert ask(enrolled(atlas, encoder, frames), encoder, looks[1]).judgement.verdict == "ambiguous"


def test_one_picture_at_two_poses_stays_ambiguous(
    atlas: Directory, encoder: Encoder, walk: list[Encoding], looks: list[Encoding]
) -> None:
    frames = [*((f"{number}.0", one) for number, one in enumerate(walk)), ("twin.0", looks[0]), ("twin.1", looks[1])]
    poses = [10.0 * number for number in range(PLACES)] + [400.0, 800.0]
    assert ask(enrolled(atlas, encoder, frames, poses), encoder, looks[2]).judgement.verdict == "ambiguous"


def test_upkeep_finds_the_stop(atlas: Directory, encoder: Encoder, walk: list[Encoding], looks: list[Encoding]) -> None:
    map_ = enrolled(atlas, encoder, with_stop(walk, looks[:30]))
    where = map_.snapshot().whereabouts
    (stop,) = stops(where)
    assert stop.places.tolist() == list(range(SPOT, SPOT + 30))
    paired = set(neighbour_pairs(where, neighborhood_of(map_)).ravel().tolist())
    assert paired >= set(stop.places.tolist())
