from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.baselines.registry import build
from core.evaluation.cache import EvaluationCache
from core.evaluation.data.pairs import TraversePair
from core.evaluation.run import Extras, compare_systems
from core.evaluation.subjects import Training
from core.frames.images import decode
from core.frames.preprocessing import Pixels
from core.frames.traverses import tolerance_truth
from core.method.catalogue import EncoderCatalogue
from tests.core.evaluation.lookup import Learner, Lookup, load, write_pictures
from tests.service.scenes import encoded, scene, seen_again


class Recorder:
    """What a watch is told."""

    def __init__(self) -> None:
        self.begun: list[tuple[str, int]] = []
        self.steps = self.ended = 0

    def begin(self, system: str, steps: int) -> None:
        self.begun.append((system, steps))

    def advance(self) -> None:
        self.steps += 1

    def end(self) -> None:
        self.ended += 1


@pytest.fixture
def pair(tmp_path: Path) -> TraversePair:
    references, queries = write_pictures(tmp_path / "r", range(10)), write_pictures(tmp_path / "q", range(10))
    return TraversePair("made", references, queries, tolerance_truth(10, 10, 0), np.arange(10), ["a note"])


def mixed_up() -> np.ndarray:
    """Places 0 and 1 look alike."""
    table = np.eye(10, dtype=np.float32)
    table[1] = table[0]
    return table


def test_systems_are_ranked_and_watched(pair: TraversePair) -> None:
    systems = [
        Lookup(mixed_up(), "worse"),
        Lookup(np.eye(10, dtype=np.float32), "better"),
        Learner(np.eye(10, dtype=np.float32)),
    ]
    watch = Recorder()
    comparison = compare_systems(
        systems, pair, Training(pair.references, "the references"), load, EvaluationCache(None), watch
    )
    assert [run.about.name for run in comparison.runs] == ["better", "learner", "worse"]
    assert watch.begun == [("worse", 30), ("better", 30), ("learner", 40)]
    assert (watch.steps, watch.ended) == (100, 3)
    assert (comparison.name, comparison.notes) == ("made", ["a note"])
    assert comparison.references == pair.references and comparison.kept.tolist() == list(range(10))
    assert (comparison.scalability, comparison.severity, comparison.regions) == (None, None, None)
    assert comparison.runs[1].about.configuration["trained on"] == "the references"


def test_a_second_run_with_one_more_system_computes_only_that_one(pair: TraversePair, tmp_path: Path) -> None:
    cache = EvaluationCache(tmp_path / "cache")
    training = Training(pair.references, "the references")
    compare_systems([Lookup(mixed_up(), "first")], pair, training, load, cache, Recorder())
    known, new = Lookup(mixed_up(), "first"), Lookup(np.eye(10, dtype=np.float32), "second")
    watch = Recorder()
    comparison = compare_systems([known, new], pair, training, load, cache, watch)
    assert (known.described, new.described, watch.steps) == (0, 20, 30)
    assert {run.about.name: run.cached for run in comparison.runs} == {"first": True, "second": False}


def test_extras_are_measured_for_every_system(pair: TraversePair) -> None:
    systems = [Lookup(np.ones((256, 3), np.float32), "two")]
    watch = Recorder()
    comparison = compare_systems(
        systems, pair, Training([], "nothing"), load, EvaluationCache(None), watch, Extras(True, True, seed=1)
    )
    assert comparison.scalability is not None and {point.system for point in comparison.scalability} == {"two"}
    assert comparison.severity is not None and len(comparison.severity) == 6
    assert watch.begun == [("two", watch.steps)]


def test_regions_are_those_of_the_best_encoder(tmp_path: Path) -> None:
    for name, again in (("r", False), ("q", True)):
        (tmp_path / name).mkdir()
        for place in range(3):
            picture = seen_again(scene(place)) if again else scene(place)
            (tmp_path / name / f"{place}.png").write_bytes(encoded(picture, ".png"))

    def read(path: Path) -> Pixels:
        return decode(path.read_bytes())

    references, queries = (sorted((tmp_path / name).iterdir()) for name in ("r", "q"))
    pair = TraversePair("scenes", references, queries, tolerance_truth(3, 3, 0), np.arange(3))
    models = EncoderCatalogue()
    systems = [build(name, models=models) for name in ("hog", "region-vlad")]
    comparison = compare_systems(systems, pair, Training([], "nothing"), read, EvaluationCache(None), Recorder())
    assert comparison.regions is not None
    assert comparison.regions_of == models.get("region-vlad").identity
    boxes = comparison.regions(references[0])
    assert boxes is not None and len(boxes) == len(models.get("region-vlad").encode(scene(0)).regions)
    assert all(run.evaluation.recall_at["1"] == 1.0 for run in comparison.runs)
