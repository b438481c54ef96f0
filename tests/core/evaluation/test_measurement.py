from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from core.evaluation.cache import EvaluationCache
from core.evaluation.data.pairs import TraversePair
from core.evaluation.measurement import best_first, measure, run
from core.evaluation.subjects import Subject, Training
from core.frames.traverses import tolerance_truth
from tests.core.evaluation.lookup import Learner, Lookup, load, write_pictures


@pytest.fixture
def pair(tmp_path: Path) -> TraversePair:
    """References 0–3, of which 2 is left out, and queries described by rows 4–7."""
    references, queries = write_pictures(tmp_path / "r", range(4)), write_pictures(tmp_path / "q", range(4, 8))
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
    return Subject(system, pair, Training(pair.references[:2], "two pictures"), load)


def test_a_run_by_hand(pair: TraversePair) -> None:
    result = run(subject(pair, Lookup(table())), EvaluationCache(None))
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


def test_stages_of_a_system_of_its_own_are_told(pair: TraversePair) -> None:
    measured = measure(subject(pair, Lookup(table(), stages=("hog", "forward"))))
    assert list(measured.milliseconds) == ["forward", "regions", "vlad", "match", "hog"]
    assert (measured.milliseconds["hog"], measured.milliseconds["vlad"]) == (2.0, None)


def test_blank_frames_score_zero_and_stay_valid(tmp_path: Path) -> None:
    made = np.zeros((3, 2), np.float32)
    made[0] = [1.0, 0.0]
    references, queries = write_pictures(tmp_path / "r", [0, 1]), write_pictures(tmp_path / "q", [2])
    pair = TraversePair("blank", references, queries, [np.array([1])], np.array([0, 1]))
    figures = run(subject(pair, Lookup(made)), EvaluationCache(None)).evaluation
    assert (figures.auc_pr, figures.one_class, figures.auc_roc) == (0.0, "none right", None)
    assert figures.recall_at == {"1": 0.0, "5": 1.0, "10": 1.0}


def test_the_second_time_nothing_is_described(pair: TraversePair, tmp_path: Path) -> None:
    cache = EvaluationCache(tmp_path / "cache")
    first = run(subject(pair, Learner(table())), cache)
    system = Learner(table())
    second = run(subject(pair, system), cache)
    assert (system.described, system.seen) == (0, [])
    assert second.cached and not first.cached
    assert second.evaluation == first.evaluation  # the times of the first run as well
    assert second.identity == first.identity != system.identity  # that of the trained system
    assert second.outcomes == first.outcomes
    assert np.array_equal(second.scores, first.scores)
    assert second.evaluation.trained_on == "two pictures"


def test_another_truth_judges_what_was_measured(pair: TraversePair, tmp_path: Path) -> None:
    cache = EvaluationCache(tmp_path / "cache")
    run(subject(pair, Lookup(table())), cache)
    wider = replace(pair, truth=tolerance_truth(4, 4, 3))
    judged = run(subject(wider, Lookup(table())), cache)
    assert judged.cached and judged.evaluation.one_class == "all right"


@pytest.mark.parametrize("damage", [b"", b"nonsense", None])
def test_a_damaged_entry_is_measured_again(pair: TraversePair, tmp_path: Path, damage: bytes | None) -> None:
    cache = EvaluationCache(tmp_path / "cache")
    first = run(subject(pair, Lookup(table())), cache)
    (entry,) = (tmp_path / "cache").iterdir()
    entry.write_bytes(entry.read_bytes()[:-40] if damage is None else damage)
    system = Lookup(table())
    second = run(subject(pair, system), cache)
    assert system.described == 7 and not second.cached
    assert second.outcomes == first.outcomes
    assert run(subject(pair, Lookup(table())), cache).cached


def test_an_entry_of_another_shape_is_measured_again(pair: TraversePair, tmp_path: Path) -> None:
    cache = EvaluationCache(tmp_path / "cache")
    made = subject(pair, Lookup(table()))
    run(made, cache)
    entry = cache.load(made.key("run"))
    assert entry is not None
    cache.store(made.key("run"), replace(entry, arrays={"scores": np.zeros((1, 1), np.float32)}))
    assert not run(subject(pair, Lookup(table())), cache).cached
    cache.store(made.key("run"), replace(entry, values={"identity": "x"}))
    assert not run(subject(pair, Lookup(table())), cache).cached


def test_the_best_comes_first(pair: TraversePair) -> None:
    right = run(subject(pair, Lookup(table(), "right")), EvaluationCache(None))
    blank = run(subject(pair, Lookup(np.zeros((8, 4), np.float32), "blank")), EvaluationCache(None))
    assert [one.about.name for one in best_first([blank, right])] == ["right", "blank"]
