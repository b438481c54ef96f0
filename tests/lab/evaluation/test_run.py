"""The evaluation from top to bottom: one system by hand, what the cache gives back, several systems together."""

from __future__ import annotations

from dataclasses import replace
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
from lab.evaluation.run import Extras, best_first, compare_systems, evaluate, measure
from lab.evaluation.subject import Subject, Training
from tests.lab.evaluation.lookup import Learner, Lookup, load, write_images
from tests.service.scenes import encoded, scene, seen_again

# One system


@pytest.fixture
def few(tmp_path: Path) -> TraversePair:
    """References 0–3, of which 2 is left out, and queries described by rows 4–7."""
    references, queries = write_images(tmp_path / "r", range(4)), write_images(tmp_path / "q", range(4, 8))
    return TraversePair("made", references, queries, tolerance_truth(4, 4, 0), np.array([0, 1, 3]))


def table() -> np.ndarray:
    made = np.zeros((8, 4), np.float32)
    made[:4] = np.eye(4)
    made[4] = [0.8, 0.2, 0.0, 0.0]  # retrieves 0: right, score 0.4
    made[5] = [0.0, 0.3, 0.6, 0.0]  # would retrieve 2, which is left out; 1 is second: right, 0.15
    made[6] = [1.0, 0.0, 0.0, 0.0]  # its reference 2 is left out; retrieves 0 with the score 0.5
    made[7] = [0.0, 0.0, 0.0, 1.0]  # retrieves 3: right, score 0.5
    return made


def subject(pair: TraversePair, system: Lookup) -> Subject:
    return Subject(system, pair, Training(pair.references[:2], "two images"), load)


def test_a_run_by_hand(few: TraversePair) -> None:
    result = evaluate(subject(few, Lookup(table())), EvaluationCache(None))
    outcomes, figures = result.outcomes, result.evaluation
    assert [(o.retrieved, o.matched, o.rank) for o in outcomes] == [
        (0, True, 1),
        (1, True, 1),
        (0, False, None),
        (3, True, 1),
    ]
    assert [o.score for o in outcomes] == pytest.approx([0.4, 0.15, 0.5, 0.5])
    # Ranked: {0.5 right, 0.5 wrong}, 0.4 right, 0.15 right: (0, 1), (1/3, 1/2), (2/3, 2/3), (1, 3/4).
    assert figures.auc_pr == pytest.approx((1.5 / 2 + (1 / 2 + 2 / 3) / 2 + (2 / 3 + 3 / 4) / 2) / 3)
    assert figures.auc_roc == pytest.approx(0.5 / 3)
    assert figures.recall_at == {"1": 1.0, "5": 1.0, "10": 1.0}
    assert figures.recall_at_full_precision == 0.0
    assert figures.extended_precision == pytest.approx(0.25)  # one of the two best is right
    assert (figures.queries, figures.references, figures.negatives, figures.encoder) == (4, 3, 1, "lookup@0")
    # Above 0.5, the score of the only new place, nothing is accepted.
    assert figures.thresholds[0].threshold == 0.5
    assert figures.thresholds[0].after.model_dump() == {
        "true_positives": 0,
        "false_positives": 0,
        "false_negatives": 3,
        "true_negatives": 1,
    }
    assert result.bytes_per_place == figures.bytes_per_place == 4 * 4 + 2
    assert figures.milliseconds["forward"] == 2.0
    assert figures.milliseconds["regions"] is None
    assert result.milliseconds == figures.milliseconds
    assert (figures.milliseconds["match"] or 0) > 0 and (figures.describe_milliseconds or 0) > 0
    assert result.scores.shape == (4, 3) and result.scores.dtype == np.float32
    assert not result.cached


def test_stages_of_a_system_of_its_own_are_reported(few: TraversePair) -> None:
    measured = measure(subject(few, Lookup(table(), stages=("hog", "forward"))))
    assert list(measured.milliseconds) == ["forward", "regions", "vlad", "match", "hog"]
    assert (measured.milliseconds["hog"], measured.milliseconds["vlad"]) == (2.0, None)


def test_blank_frames_score_zero_and_stay_valid(tmp_path: Path) -> None:
    made = np.zeros((3, 2), np.float32)
    made[0] = [1.0, 0.0]
    references, queries = write_images(tmp_path / "r", [0, 1]), write_images(tmp_path / "q", [2])
    blank = TraversePair("blank", references, queries, [np.array([1])], np.array([0, 1]))
    figures = evaluate(subject(blank, Lookup(made)), EvaluationCache(None)).evaluation
    assert (figures.auc_pr, figures.one_class, figures.auc_roc) == (0.0, "none right", None)
    assert figures.recall_at == {"1": 0.0, "5": 1.0, "10": 1.0}


def test_the_second_time_nothing_is_described(few: TraversePair, tmp_path: Path) -> None:
    cache = EvaluationCache(tmp_path / "cache")
    first = evaluate(subject(few, Learner(table())), cache)
    system = Learner(table())
    second = evaluate(subject(few, system), cache)
    assert (system.described, system.seen) == (0, [])
    assert second.cached and not first.cached
    assert second.evaluation == first.evaluation  # the times of the first run as well
    assert second.identity == first.identity != system.identity  # that of the trained system
    assert second.outcomes == first.outcomes
    assert np.array_equal(second.scores, first.scores)
    assert second.evaluation.trained_on == "two images"


def test_another_truth_judges_what_was_measured(few: TraversePair, tmp_path: Path) -> None:
    cache = EvaluationCache(tmp_path / "cache")
    evaluate(subject(few, Lookup(table())), cache)
    wider = replace(few, truth=tolerance_truth(4, 4, 3))
    judged = evaluate(subject(wider, Lookup(table())), cache)
    assert judged.cached and judged.evaluation.one_class == "all right"


@pytest.mark.parametrize("damage", [b"", b"nonsense", None])
def test_a_damaged_entry_is_measured_again(few: TraversePair, tmp_path: Path, damage: bytes | None) -> None:
    cache = EvaluationCache(tmp_path / "cache")
    first = evaluate(subject(few, Lookup(table())), cache)
    (entry,) = (tmp_path / "cache").iterdir()
    entry.write_bytes(entry.read_bytes()[:-40] if damage is None else damage)
    system = Lookup(table())
    second = evaluate(subject(few, system), cache)
    assert system.described == 7 and not second.cached
    assert second.outcomes == first.outcomes
    assert evaluate(subject(few, Lookup(table())), cache).cached


def test_an_entry_of_another_shape_is_measured_again(few: TraversePair, tmp_path: Path) -> None:
    cache = EvaluationCache(tmp_path / "cache")
    made = subject(few, Lookup(table()))
    evaluate(made, cache)
    entry = cache.load(made.key("run"))
    assert entry is not None
    cache.store(made.key("run"), replace(entry, arrays={"scores": np.zeros((1, 1), np.float32)}))
    assert not evaluate(subject(few, Lookup(table())), cache).cached
    cache.store(made.key("run"), replace(entry, values={"identity": "x"}))
    assert not evaluate(subject(few, Lookup(table())), cache).cached


def test_the_best_comes_first(few: TraversePair) -> None:
    right = evaluate(subject(few, Lookup(table(), "right")), EvaluationCache(None))
    blank = evaluate(subject(few, Lookup(np.zeros((8, 4), np.float32), "blank")), EvaluationCache(None))
    assert [one.about.name for one in best_first([blank, right])] == ["right", "blank"]


# Several systems


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
    references, queries = write_images(tmp_path / "r", range(10)), write_images(tmp_path / "q", range(10))
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
    assert comparison.references == pair.references and comparison.retained.tolist() == list(range(10))
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
            frame = seen_again(scene(place)) if again else scene(place)
            (tmp_path / name / f"{place}.png").write_bytes(encoded(frame, ".png"))

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
