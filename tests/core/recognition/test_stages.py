"""The second stage examines other places than the best one, however many neighbours the best one has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from core.judgement.probability import Curve
from core.judgement.verdict import Calibration, judge
from core.method.catalogue import EncoderCatalogue
from core.places import Neighborhood, Whereabouts
from core.recognition.stages import Candidates, examine, score_matrix
from tests.core.judgement.test_verdict import in_sequence
from tests.service.scenes import scene

SAME = Neighborhood(radius=5.0, frames=60)
CALIBRATION = Calibration(
    source="encoder-default", threshold=0.2, margin=0.02, background_mean=0.02, background_deviation=0.01
)


def crowd() -> tuple[NDArray[np.float32], Whereabouts, NDArray[np.float32]]:
    """Fifty frames of one place, then its twin and other places; first scores falling, and what each would gain."""
    scores = np.linspace(0.2, 0.1, 60).astype(np.float32)
    gains = np.full(60, 0.05, np.float32)
    gains[0], gains[50] = 0.4, 0.48  # the twin is as good
    return scores, in_sequence(60, [*range(50), *range(1000, 2000, 100)]), gains


def test_a_prior_takes_from_the_score_of_both_stages() -> None:
    calibration = CALIBRATION.model_copy(update={"curve": Curve(slope=40.0, intercept=-3.0)})
    first = np.array([0.05, 0.05], np.float32)  # a prior takes 0.058, but no more than what is above 0.02 of these
    scores, weights = np.array([0.3, 0.27], np.float32), np.log([0.1, 1.0])
    ordered = scores - np.array([0.03, 0.0], np.float32)
    examined, rows = np.ones(2, np.bool_), np.array([7, 8])
    found = Candidates(rows, scores, first, in_sequence(2), examined, weights, ordered, 2).weighed(calibration)
    assert found.rows.tolist() == [8, 7]
    assert found.ordered.tolist() == pytest.approx([0.27, 0.3 - np.log(10) / 40], abs=1e-6)
    assert found.scores.tolist() == pytest.approx([0.27, 0.3])


def test_a_similar_place_behind_many_neighbours_is_examined() -> None:
    scores, places, gains = crowd()
    found = examine(scores, places, SAME, 30, lambda rows: gains[rows])
    assert found.examined.sum() == 35
    judgement = judge(found.scores, places.take(found.order), CALIBRATION, SAME, found.examined)
    assert judgement.verdict == "ambiguous"
    assert judgement.margin is not None and judgement.margin < 0.02


def test_without_examining_it_the_answer_would_be_recognized() -> None:
    scores, places, gains = crowd()
    raised = scores.copy()
    raised[:30] += gains[:30]
    order = np.argsort(-raised, kind="stable")
    judgement = judge(raised[order], places.take(order), CALIBRATION, SAME, 30)
    assert judgement.verdict == "recognized"


def test_no_more_is_examined_if_the_candidates_are_different_places() -> None:
    scores = np.linspace(0.2, 0.1, 60).astype(np.float32)
    asked: list[int] = []

    def gains(rows: NDArray[np.int64]) -> NDArray[np.float32]:
        asked.extend(rows.tolist())
        return np.full(len(rows), 0.1, np.float32)

    found = examine(scores, in_sequence(60), Neighborhood(5.0, 3), 30, gains)
    assert asked == list(range(30))
    assert found.order.tolist() == list(range(60))
    assert found.examined.tolist() == [True] * 30 + [False] * 30


def test_the_most_promising_of_the_screened_places_are_examined() -> None:
    """Of six that are screened two, and then the best that are other than those: screened ones first."""
    scores = np.linspace(0.2, 0.1, 10).astype(np.float32)
    promises = np.array([0, 0.3, 0, 0, 0.5, 0.1, 9, 9, 9, 9], np.float32)
    gains = np.linspace(0.1, 0.2, 10).astype(np.float32)
    asked: list[int] = []

    def examined(rows: NDArray[np.int64]) -> NDArray[np.float32]:
        asked.extend(rows.tolist())
        return gains[rows]

    found = examine(scores, in_sequence(10), SAME, 2, examined, 6, lambda rows: promises[rows], others=0)
    assert asked == [4, 1]
    assert sorted(found.order[found.examined].tolist()) == [1, 4]
    np.testing.assert_allclose(found.scores[:2], sorted(scores[[1, 4]] + gains[[1, 4]], reverse=True))
    asked.clear()
    close = in_sequence(10, [0, 4, 100, 200, 5, 300, 400, 500, 600, 700])  # 1 and 4 are one place
    examine(scores, close, Neighborhood(5.0, 3), 2, examined, 6, lambda rows: promises[rows], others=3)
    assert asked == [4, 1, 5, 0, 2]


@pytest.mark.parametrize("screened", [0, 6])
def test_a_look_that_is_not_believed_does_not_take_the_turn_of_its_place(screened: int) -> None:
    """Frames 0 and 5 are of one place; the first is a learnt look, which a match of 0.8 at least makes believed."""
    scores = np.array([0.6, 0.55, 0.5, 0.45, 0.4, 0.35], np.float32)
    gains = np.array([0.1, 0, 0, 0, 0, 0.5], np.float32)
    places = replace(in_sequence(6, [0, 100, 200, 300, 400, 0]), least=np.array([0.8, *[-np.inf] * 5], np.float32))
    promise = (lambda rows: np.where(rows == 0, 0.5, 0.0).astype(np.float32)) if screened else None
    found = examine(scores, places, Neighborhood(5.0, 3), 2, lambda rows: gains[rows], screened, promise, others=1)
    assert found.order[0] == 5 and found.examined[0]
    assert sorted(found.order[found.examined].tolist()) == [0, 1, 5]
    believed = replace(places, least=np.array([0.65, *[-np.inf] * 5], np.float32))
    found = examine(scores, believed, Neighborhood(5.0, 3), 2, lambda rows: gains[rows], others=1)
    assert sorted(found.order[found.examined].tolist()) == [0, 1], "one frame of a view is enough"
    # A prior raises the value of a frame, and not the score by which it is believed.
    found = examine(scores + 0.3, places, Neighborhood(5.0, 3), 2, lambda rows: gains[rows], others=1, alone=scores)
    assert 5 in found.order[found.examined]


@pytest.mark.parametrize("n", [0, 1, 4])
def test_maps_smaller_than_the_number_of_candidates(n: int) -> None:
    found = examine(
        np.linspace(0.2, 0.1, n).astype(np.float32),
        in_sequence(n),
        SAME,
        30,
        lambda rows: np.zeros(len(rows), np.float32),
    )
    assert len(found.order) == n and found.examined.all()


def test_without_a_second_stage_nothing_is_examined() -> None:
    scores, places, gains = crowd()
    found = examine(scores, places, SAME, 0, lambda rows: gains[rows])
    assert not found.examined.any()
    assert np.array_equal(found.scores, scores)


def test_all_queries_of_a_traverse_are_scored_as_a_map_scores_them() -> None:
    encoder = EncoderCatalogue().get("m-region-vlad")
    cells = encoder.encode(scene(1)).local
    count = encoder.candidates + 20
    products = np.linspace(2.0, 1.0, count).astype(np.float32)[np.newaxis]
    first = encoder.scores_from_inner_products(products)
    gained = score_matrix(encoder, products, cells[np.newaxis], np.stack([cells] * count)) - first
    assert (gained[0, : encoder.candidates] > 0.5).all()
    np.testing.assert_allclose(gained[0, encoder.candidates :], 0, atol=1e-6)


def test_without_a_second_stage_the_matrix_is_that_of_the_first() -> None:
    encoder = EncoderCatalogue().get("region-vlad")
    products = np.linspace(-1, 1, 12, dtype=np.float32).reshape(3, 4)
    none = np.zeros((0, 0), np.int8)
    np.testing.assert_array_equal(
        score_matrix(encoder, products, none, none), encoder.scores_from_inner_products(products)
    )
