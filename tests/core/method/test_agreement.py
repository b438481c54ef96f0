"""The second stage on grids where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from core.method.agreement import (
    RESOLUTION,
    STEADINESS,
    AgreementDefinition,
    agreement,
    correspondences,
    local_descriptors,
    promise,
    standardized,
)

ROWS, COLUMNS = 4, 6


def definition(reach: tuple[int, int] = (1, 2), values: int = 8, share: float = 0.8) -> AgreementDefinition:
    return AgreementDefinition(layers=("a",), values=values, weights=(1.0,), reach=reach, candidates=5, share=share)


def random_cells(seed: int, count: int = ROWS * COLUMNS, values: int = 8) -> NDArray[np.int8]:
    rows = np.random.default_rng(seed).standard_normal((count, values)).astype(np.float32)
    return local_descriptors([rows / np.linalg.norm(rows, axis=1, keepdims=True)], definition(values=values))


@pytest.mark.parametrize("seed", range(6))
def test_the_gain_is_the_share_of_the_mean_squared_cosine(seed: int) -> None:
    stage, query = definition(), random_cells(seed)
    references = np.stack([random_cells(100 + seed + n) for n in range(3)])
    gains = agreement(query, references, COLUMNS, stage)
    for reference, gain in zip(references, gains, strict=True):
        found = correspondences(query, reference, COLUMNS, stage.reach)
        assert len(found.query)
        products = np.einsum("nl,nl->n", query[found.query].astype(int), reference[found.reference].astype(int))
        np.testing.assert_allclose(found.cosines, products / RESOLUTION**2, rtol=1e-6)
        assert gain == pytest.approx(stage.share * float((found.cosines**2).sum()) / len(query), rel=1e-5)


def test_a_frame_agrees_with_itself_in_every_cell() -> None:
    cells, stage = random_cells(0, values=64), definition(values=64)
    found = correspondences(cells, cells, COLUMNS, stage.reach)
    np.testing.assert_array_equal(found.query, found.reference)
    assert len(found.query) == ROWS * COLUMNS
    assert agreement(cells, cells[np.newaxis], COLUMNS, stage)[0] == pytest.approx(stage.share, rel=0.02)


def test_a_shifted_frame_is_found_within_reach_and_not_beyond() -> None:
    cells = random_cells(3, values=64)
    shifted = np.roll(cells.reshape(ROWS, COLUMNS, -1), 2, axis=1).reshape(ROWS * COLUMNS, -1)
    near = correspondences(cells, shifted, COLUMNS, (0, 2))
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


def test_standardized_cells_by_hand() -> None:
    cells = np.array([[1, 0], [0, 0], [0.6, 0.8]], np.float32)
    mean, deviation = np.array([0.8, 0.4]), np.array([0.2, 0.4])
    wanted = (cells[[0, 2]] - 0.75 * mean) / (deviation + STEADINESS * 0.3)
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    found = standardized(cells, 0.75)
    np.testing.assert_allclose(found[[0, 2]], wanted, atol=1e-6)
    assert not found[1].any() and not standardized(np.zeros((3, 2), np.float32), 0.75).any()
    np.testing.assert_array_equal(standardized(cells[:1], 0.75), cells[:1])  # nothing deviates
    for together in (np.stack([cells, cells[::-1]], axis=1), random_cells(4).reshape(-1, 2, 4).astype(np.float32)):
        each = [standardized(np.ascontiguousarray(together[:, layer]), 0.75) for layer in (0, 1)]
        np.testing.assert_array_equal(standardized(together, 0.75), np.stack(each, axis=1))  # other layers do not count
    stage = definition(values=2)
    made = local_descriptors([cells], stage.model_copy(update={"centred": 0.75}))
    np.testing.assert_array_equal(made, local_descriptors([found], stage))
    assert not np.array_equal(made, local_descriptors([cells], stage))


def test_a_promise_is_of_a_sample_of_cells_and_of_one_direction() -> None:
    """Each of the sampled cells of a reference has the best one of the query within reach."""
    stage, query = definition(), random_cells(1)
    references = np.stack([random_cells(2), random_cells(3), np.zeros_like(query)])
    cells = np.arange(ROWS * COLUMNS)
    row, column = np.divmod(cells, COLUMNS)
    sample = cells[(row % 3 == 0) & (column % 3 == 0)]
    wanted = []
    for reference in references:
        products = reference[sample].astype(float) @ query.astype(float).T / RESOLUTION**2
        far = (np.abs(row[sample, None] - row) > stage.reach[0]) | (
            np.abs(column[sample, None] - column) > stage.reach[1]
        )
        best = np.where(far, 0, products).max(axis=1).clip(0)
        wanted.append(stage.share * (best**2).mean())
    np.testing.assert_allclose(promise(query, references, COLUMNS, stage), wanted, rtol=1e-5)
    with pytest.raises(ValueError, match="cannot be compared"):
        promise(query, references[:, :6], COLUMNS, stage)


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
        {"centred": 1.5},
        {"screened": 1},
    ],
)
def test_a_definition_that_makes_no_sense_is_refused(wrong: dict[str, object]) -> None:
    right = {"layers": ("a", "b"), "values": 2, "weights": (0.5, 0.5), "reach": (1, 1), "candidates": 1, "share": 0.5}
    AgreementDefinition.model_validate(right)
    with pytest.raises(ValidationError):
        AgreementDefinition.model_validate({**right, **wrong})


def candidates(values: int) -> NDArray[np.int8]:
    return np.random.default_rng(1).integers(-90, 91, (5, ROWS * COLUMNS, values)).astype(np.int8)


@pytest.mark.parametrize("values", [8, 3])
def test_candidates_are_scored_each_for_itself(values: int) -> None:
    """The compiled loop takes arrays in any order of memory, and such that must not be written to."""
    shown, stage = candidates(values), definition(values=values)
    query = shown[2].copy()
    gains = agreement(query, shown, COLUMNS, stage)
    assert gains[2] > gains[[0, 1, 3, 4]].max() > 0
    np.testing.assert_allclose(gains[::-1], agreement(query, shown[::-1], COLUMNS, stage), rtol=1e-6)
    query.flags.writeable = shown.flags.writeable = False
    np.testing.assert_allclose(gains, agreement(query, shown, COLUMNS, stage), rtol=1e-6)


def test_grids_that_are_not_alike_are_refused() -> None:
    stage = definition()
    for query, columns in (
        (np.zeros((24, 4), np.int8), 6),
        (np.zeros((9, 8), np.int8), 3),
        (np.zeros((24, 8), np.int8), 5),
    ):
        with pytest.raises(ValueError, match="cannot be compared"):
            agreement(query, candidates(8), columns, stage)
