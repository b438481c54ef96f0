"""Verdicts in maps of a few references up to all of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.frames.images import decode
from core.frames.preprocessing import Pixels
from core.frames.traverses import tolerance_truth
from core.method.catalogue import EncoderCatalogue
from lab.baselines.registry import build
from lab.evaluation.cache import EvaluationCache
from lab.evaluation.data.pairs import TraversePair
from lab.evaluation.map_sizes import balanced_error, map_sizes
from lab.evaluation.subject import Subject, Training
from tests.lab.evaluation.lookup import Lookup, load, write_images
from tests.service.scenes import encoded, scene, seen_again

PLACES = 24


def read(path: Path) -> Pixels:
    return decode(path.read_bytes())


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> TraversePair:
    """Every place looks different, and is seen again a little changed."""
    folder = tmp_path_factory.mktemp("walk")
    for name in ("r", "q"):
        (folder / name).mkdir()
    for place in range(PLACES):
        (folder / "r" / f"{place:02}.png").write_bytes(encoded(scene(place), ".png"))
        (folder / "q" / f"{place:02}.png").write_bytes(encoded(seen_again(scene(place)), ".png"))
    references, queries = (sorted((folder / name).iterdir()) for name in ("r", "q"))
    return TraversePair("walk", references, queries, tolerance_truth(PLACES, PLACES, 0), np.arange(PLACES))


@pytest.mark.thorough
def test_known_places_and_strangers_query_maps_of_every_size(walk: TraversePair, tmp_path: Path) -> None:
    system = build("m-region-vlad", models=EncoderCatalogue())
    cache = EvaluationCache(tmp_path)
    points = map_sizes(Subject(system, walk, Training([], "nothing"), read), cache)
    assert [point.places for point in points] == [1, 2, 5, 10, PLACES]
    assert all(point.strangers_recognized == 0 for point in points[:-1]), "what was never seen looks like nothing here"
    assert points[-1].strangers == 0 and points[-1].calibration_error is None
    assert points[0].known == 6 and points[-1].known == 20
    assert points[-1].known_recognized > 0.9
    for point in points:
        assert point.verified_known is not None and point.verified_known >= 0.9, "the scenes are rigid"
        assert (point.verified_error is None) == (point.strangers == 0)
    fitting = points[0].verified_strangers
    assert fitting is not None and fitting <= 1 / 8, (
        "only scenes that show the same word in the same spot, one in eight"
    )
    again = map_sizes(Subject(system, walk, Training([], "nothing"), load), cache)
    assert again == points, "from the cache, without reading an image"


def test_a_system_without_probabilities_has_no_points(tmp_path: Path) -> None:
    images = write_images(tmp_path, range(4))
    pair = TraversePair("made", images, images, tolerance_truth(4, 4, 0), np.arange(4))
    subject = Subject(Lookup(np.eye(4, dtype=np.float32)), pair, Training([], "nothing"), load)
    assert map_sizes(subject, EvaluationCache(None)) == []


def test_known_and_unknown_count_alike_in_the_error() -> None:
    known = np.array([True] + 9 * [False])
    assert balanced_error(np.full(10, 0.5), known, known) == pytest.approx(0)
    assert balanced_error(np.full(10, 0.1), known, known) == pytest.approx(0.4)
    assert balanced_error(known.astype(np.float64), known, known) == 0
