"""The figures of the benchmark of geometric verification, on candidates whose figures are known."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.geometry.tasks import Pictures, Task, from_elsewhere, relit
from benchmarks.geometry.verification import BEFORE, OURS, SHIPPED, WAYS, Ranked, Weights, best_weights, recall
from lab.training.validation import Encodings
from service.commands.timing.samples import sample_frame

NOTHING = Pictures(Encodings(np.zeros((0, 1), np.float32), np.zeros((0, 1, 1), np.int8)), [])
TASK = Task("made up", NOTHING, NOTHING, np.zeros((2, 2), np.bool_), 0, "made up", True)


def ranked(true: int, glance: int = 2) -> Ranked:
    """Three candidates: the best by cells, the best by its descriptor, and the one that keypoints fit."""
    return Ranked(
        similarity=np.array([0.1, 0.2, 0.12]),
        agreement=np.array([0.2, 0.05, 0.0]),
        by_similarity=np.array([2.0, 0.0, 1.0]),
        by_glance=np.where(np.arange(3) == glance, 0.0, 1.0 + np.arange(3)),
        share=np.array([0.0, 0.0, 0.5]),
        true=np.arange(3) == true,
    )


@pytest.mark.parametrize(
    ("weights", "counts", "true"),
    [
        ((1.0, 1.0, 0.0), (3, 0, 0), 0),
        ((2.0, 0.5, 0.0), (3, 0, 0), 1),
        (SHIPPED, (3, 0, 0), 2),
        (SHIPPED, (1, 1, 0), 1),
        (SHIPPED, (1, 0, 1), 2),
    ],
)
def test_weights_and_sources_decide_which_place_is_first(
    weights: Weights, counts: tuple[int, int, int], true: int
) -> None:
    assert recall([ranked(true)], weights, counts) == 1.0
    assert recall([ranked(true), ranked((true + 1) % 3)], weights, counts) == 0.5


def test_sources_do_not_choose_a_place_twice() -> None:
    assert ranked(0, glance=0).chosen(1, 1, 1).tolist() == [True, True, True]
    assert ranked(0, glance=0).chosen(1, 0, 1).sum() == 2


def test_the_best_weights_are_those_of_the_tasks_to_fit_on() -> None:
    best, reached, ours = best_weights([(TASK, [ranked(2)] * 3)])
    assert reached == ours == 1.0 and best[2] > 0
    assert WAYS["three stages"] == (SHIPPED, OURS) and BEFORE != SHIPPED


def test_photographs_are_seen_from_elsewhere_in_other_light() -> None:
    frame = sample_frame(2)
    views = [
        relit(from_elsewhere(frame, np.random.default_rng(seed), (160, 120), 1.0), np.random.default_rng(seed))
        for seed in (0, 0, 1)
    ]
    assert views[0].shape == (120, 160, 3) and np.array_equal(views[0], views[1])
    assert not np.array_equal(views[0], views[2])
