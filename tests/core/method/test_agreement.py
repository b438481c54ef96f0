"""The second stage against a plain reading of its definition, and on grids where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from core.method.agreement import (
    RESOLUTION,
    AgreementDefinition,
    agreement,
    correspondences,
    local_descriptors,
    reranked,
)

ROWS, COLUMNS = 4, 6


def definition(reach: tuple[int, int] = (1, 2), values: int = 8, share: float = 0.8) -> AgreementDefinition:
    return AgreementDefinition(layers=("a",), values=values, weights=(1.0,), reach=reach, candidates=5, share=share)


def random_cells(seed: int, count: int = ROWS * COLUMNS, values: int = 8) -> NDArray[np.int8]:
    rows = np.random.default_rng(seed).standard_normal((count, values)).astype(np.float32)
    return local_descriptors([rows / np.linalg.norm(rows, axis=1, keepdims=True)], definition(values=values))


def plainly(query: NDArray[np.int8], reference: NDArray[np.int8], stage: AgreementDefinition) -> dict[int, int]:
    """Mutual best matches by two loops over all cells."""
    products = query.astype(int) @ reference.T.astype(int)

    def best(of: int, values: NDArray[np.int_]) -> int:
        y, x = divmod(of, COLUMNS)
        within = [
            cell
            for cell in range(len(values))
            if abs(cell // COLUMNS - y) <= stage.reach[0] and abs(cell % COLUMNS - x) <= stage.reach[1]
        ]
        return max(within, key=lambda cell: (values[cell], -cell))

    there = {cell: best(cell, products[cell]) for cell in range(len(query))}
    return {a: b for a, b in there.items() if best(b, products[:, b]) == a and products[a, b] > 0}


@pytest.mark.parametrize("seed", range(6))
def test_mutual_matches_and_their_sum_equal_a_plain_search(seed: int) -> None:
    stage, query = definition(), random_cells(seed)
    references = np.stack([random_cells(100 + seed + n) for n in range(3)])
    gains = agreement(query, references, COLUMNS, stage)
    for reference, gain in zip(references, gains, strict=True):
        expected = plainly(query, reference, stage)
        found = correspondences(query, reference, COLUMNS, stage)
        assert dict(zip(found.query.tolist(), found.reference.tolist(), strict=True)) == expected
        cosines = [
            float(query[a].astype(float) @ reference[b].astype(float)) / RESOLUTION**2 for a, b in expected.items()
        ]
        np.testing.assert_allclose(found.cosines, cosines, rtol=1e-5)
        assert gain == pytest.approx(stage.share * sum(c * c for c in cosines) / len(query), rel=1e-5)


def test_a_frame_agrees_with_itself_in_every_cell() -> None:
    cells, stage = random_cells(0, values=64), definition(values=64)
    found = correspondences(cells, cells, COLUMNS, stage)
    np.testing.assert_array_equal(found.query, found.reference)
    assert len(found.query) == ROWS * COLUMNS
    assert agreement(cells, cells[np.newaxis], COLUMNS, stage)[0] == pytest.approx(stage.share, rel=0.02)


def test_a_shifted_frame_is_found_within_reach_and_not_beyond() -> None:
    cells = random_cells(3, values=64)
    shifted = np.roll(cells.reshape(ROWS, COLUMNS, -1), 2, axis=1).reshape(ROWS * COLUMNS, -1)
    near = correspondences(cells, shifted, COLUMNS, definition((0, 2), 64))
    moved = near.reference % COLUMNS - near.query % COLUMNS
    assert np.count_nonzero(moved == 2) >= ROWS * (COLUMNS - 2)
    within, beyond = (agreement(cells, shifted[np.newaxis], COLUMNS, definition((0, d), 64))[0] for d in (2, 1))
    assert within > 3 * beyond


def test_blank_frames_agree_with_nothing() -> None:
    blank = np.zeros((ROWS * COLUMNS, 8), np.int8)
    assert agreement(blank, np.stack([blank, random_cells(1)]), COLUMNS, definition()).tolist() == [0, 0]
    assert agreement(random_cells(1), np.zeros((0, ROWS * COLUMNS, 8), np.int8), COLUMNS, definition()).shape == (0,)


def test_layers_count_by_their_weights() -> None:
    stage = AgreementDefinition(
        layers=("a", "b"), values=4, weights=(0.75, 0.25), reach=(0, 0), candidates=1, share=0.5
    )
    same, other = np.full((1, 4), 0.5, np.float32), np.array([[0.5, -0.5, 0.5, -0.5]], np.float32)
    query = local_descriptors([same, same], stage)
    half = local_descriptors([same, other], stage)
    scaled = query.astype(int) @ half[0].astype(int) / RESOLUTION**2
    assert scaled[0] == pytest.approx(0.75, abs=0.01)
    assert query.shape == (1, 8)


def test_a_ranking_is_sorted_again_and_ties_keep_their_order() -> None:
    order, scores = reranked(np.array([0.5, 0.4, 0.3, 0.2], np.float32), np.array([0.0, 0.1, 0.3], np.float32))
    assert order.tolist() == [2, 0, 1, 3]
    np.testing.assert_allclose(scores, [0.6, 0.5, 0.5, 0.2], atol=1e-6)
    order, scores = reranked(np.array([0.5, 0.4], np.float32), np.zeros(0, np.float32))
    assert order.tolist() == [0, 1]


@pytest.mark.parametrize(
    "wrong",
    [
        {"weights": (0.5, 0.4)},
        {"weights": (0.5,)},
        {"reach": (-1, 2)},
        {"layers": ()},
        {"share": 0.0},
        {"share": 1.0},
        {"candidates": 0},
    ],
)
def test_a_definition_that_makes_no_sense_is_refused(wrong: dict[str, object]) -> None:
    right = {"layers": ("a", "b"), "values": 2, "weights": (0.5, 0.5), "reach": (1, 1), "candidates": 1, "share": 0.5}
    AgreementDefinition.model_validate(right)
    with pytest.raises(ValidationError):
        AgreementDefinition.model_validate({**right, **wrong})
