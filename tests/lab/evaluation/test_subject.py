from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import InvalidModel
from core.frames.traverses import tolerance_truth
from lab.baselines.system import Description, ReferenceIndex, Trainable
from lab.evaluation.data.pairs import TraversePair
from lab.evaluation.subject import Subject, Training
from tests.lab.evaluation.lookup import Learner, Lookup, Together, load, write_images

TABLE = np.eye(6, dtype=np.float32)


@pytest.fixture
def pair(tmp_path: Path) -> TraversePair:
    references, queries = write_images(tmp_path / "r", [0, 1, 2, 3]), write_images(tmp_path / "q", [3, 1, 4])
    return TraversePair("made", references, queries, tolerance_truth(3, 4, 0), np.array([0, 1, 3]))


def lessons(pair: TraversePair) -> Training:
    return Training(pair.references[:2], "two images", seed=1)


def test_nothing_is_described_before_it_is_requested_and_then_once(pair: TraversePair) -> None:
    system = Lookup(TABLE)
    seen: list[None] = []
    subject = Subject(system, pair, lessons(pair), load, lambda: seen.append(None))
    assert system.described == 0
    assert len(subject.references.descriptions) == len(subject.references.milliseconds) == 3
    assert subject.references.descriptions[2].arrays["descriptor"].tolist() == TABLE[3].tolist()
    assert len(subject.queries.descriptions) == 3
    assert system.described == len(seen) == 6
    subject.score(system.index(subject.references.descriptions), subject.queries.descriptions)
    assert len(seen) == subject.steps == 9


def test_a_frame_can_be_changed_first(pair: TraversePair) -> None:
    described = Subject(Lookup(TABLE), pair, lessons(pair), load).describe(
        pair.queries, lambda pixels, number: np.asarray(pixels * 0 + number, np.uint8)
    )
    rows = [description.arrays["descriptor"].argmax() for description in described.descriptions]
    assert rows == [0, 1, 2]


class Counting(Lookup):
    """Notes how many queries come at a time."""

    def __init__(self, sizes: list[int]) -> None:
        super().__init__(TABLE)
        self.sizes = sizes

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return Counted(super().index(references), self.sizes)


@dataclass
class Counted:
    inner: ReferenceIndex
    sizes: list[int]

    def score(self, queries: Sequence[Description]) -> NDArray[np.float32]:
        self.sizes.append(len(queries))
        return self.inner.score(queries)


def test_queries_run_one_at_a_time(pair: TraversePair) -> None:
    system = Counting([])
    subject = Subject(system, pair, lessons(pair), load)
    scored = subject.score(system.index(subject.references.descriptions), subject.queries.descriptions)
    assert system.sizes == [1, 1, 1]
    assert scored.scores.tolist() == [[0, 0, 0.5], [0, 0.5, 0], [0, 0, 0]]
    assert len(scored.milliseconds) == 3 and min(scored.milliseconds) > 0


def test_a_sequential_system_gets_all_queries_together(pair: TraversePair) -> None:
    subject = Subject(Together(TABLE), pair, lessons(pair), load)
    scored = subject.score(subject.system.index(subject.references.descriptions), subject.queries.descriptions)
    third = 1 / 3
    assert np.allclose(scored.scores, [[0, -third, 1 - third], [0, 1 - third, -third], [0, -third, -third]])
    assert len(set(scored.milliseconds)) == 1 and len(scored.milliseconds) == 3


def test_a_system_that_learns_is_trained_once_and_says_from_what(pair: TraversePair) -> None:
    system = Learner(TABLE)
    assert isinstance(system, Trainable)
    seen: list[None] = []
    subject = Subject(system, pair, lessons(pair), load, lambda: seen.append(None))
    key = subject.key("run")
    assert system.seen == []
    _ = subject.queries, subject.references
    assert system.seen == [0, 1]
    assert len(seen) == 2 + 3 + 3
    assert subject.steps == 2 + 3 + 3 + 3  # and each query is compared
    assert subject.trained_on == "two images"
    assert subject.about.configuration == {"rows": 6, "trained on": "two images"}
    assert subject.key("run") == key  # the key is that of before the training, which it covers
    # The seed doubles the mean here: (row 0 + row 1) / 2 · 2.
    assert subject.queries.descriptions[0].arrays["descriptor"].tolist() == [-1, -1, 0, 1, 0, 0]
    assert Subject(Lookup(TABLE), pair, lessons(pair), load).trained_on is None


def test_the_key_covers_all_that_a_score_depends_on(pair: TraversePair, tmp_path: Path) -> None:
    def key(system: Lookup, pair: TraversePair = pair, training: Training | None = None) -> str:
        return Subject(system, pair, training or lessons(pair), load).key("run")

    more = write_images(tmp_path / "more", [3, 1, 5])
    queries = TraversePair(pair.name, pair.references, more, pair.truth, pair.retained)
    retained = TraversePair(pair.name, pair.references, pair.queries, pair.truth, np.array([0, 1]))
    others = [key(Lookup(TABLE), queries), key(Lookup(TABLE), retained), key(Lookup(TABLE, "other"))]
    assert len({key(Lookup(TABLE)), *others}) == 4
    # The truth and the name are no part of a score; training is only where something learns.
    elsewhere = TraversePair("b", pair.references, pair.queries, tolerance_truth(3, 4, 1), pair.retained)
    assert key(Lookup(TABLE), elsewhere) == key(Lookup(TABLE))
    other_lessons = [Training(pair.references[:1], "one", 1), Training(pair.references[:2], "two", 2)]
    assert all(key(Lookup(TABLE), pair, training) == key(Lookup(TABLE)) for training in other_lessons)
    assert len({key(Learner(TABLE), pair, training) for training in [lessons(pair), *other_lessons]}) == 3


def test_scores_that_are_none_are_refused(pair: TraversePair) -> None:
    table = TABLE.copy()
    table[4] = np.nan
    subject = Subject(Lookup(table), pair, lessons(pair), load)
    index = subject.system.index(subject.references.descriptions)
    with pytest.raises(InvalidModel, match="lookup gave scores"):
        subject.score(index, subject.queries.descriptions)
