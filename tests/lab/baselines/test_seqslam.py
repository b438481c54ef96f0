"""SeqSLAM: each step by hand, and the whole on a drive of known velocity."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from core.frames.preprocessing import Pixels
from lab.baselines.seqslam import (
    D_S,
    R_LOCAL,
    R_WINDOW,
    SeqSlam,
    differences,
    distinctness,
    enhance_contrast,
    patch_normalize,
    path_costs,
)
from lab.baselines.system import stack


def test_patches_are_normalized_each_by_itself() -> None:
    grey = np.zeros((8, 24), np.uint8)
    grey[:, 8:16] = np.arange(64).reshape(8, 8)
    grey[:, 16:] = 100 + 2 * np.arange(64).reshape(8, 8)
    normalized = patch_normalize(grey)
    assert not normalized[:, :8].any()  # flat
    np.testing.assert_allclose(normalized[:, 8:16], normalized[:, 16:], rtol=1e-5)  # another brightness and contrast
    np.testing.assert_allclose(normalized[0, 8], (0 - 31.5) / np.std(np.arange(64), ddof=1), rtol=1e-5)


def test_differences_are_mean_and_absolute() -> None:
    queries, references = np.array([[1, 2]], np.float32), np.array([[1, 2], [2, 0], [-1, 5]], np.float32)
    np.testing.assert_allclose(differences(queries, references), [[0, 1.5, 2.5]])


def test_contrast_is_enhanced_among_the_references_around() -> None:
    generator = np.random.default_rng(2)
    matrix = generator.random((3, 30)).astype(np.float32) + np.linspace(0, 50, 30, dtype=np.float32)
    expected = np.empty((3, 30))
    for column in range(30):
        window = matrix[:, max(0, column - R_LOCAL // 2) : column + R_LOCAL // 2 + 1]
        expected[:, column] = (matrix[:, column] - window.mean(axis=1)) / window.std(axis=1, ddof=1)
    np.testing.assert_allclose(enhance_contrast(matrix), expected - expected.min(), atol=1e-4)


def test_equal_differences_have_no_contrast() -> None:
    assert not enhance_contrast(np.full((2, 5), 3, np.float32)).any()


@pytest.mark.parametrize("velocity", [0.8, 0.9, 1.0, 1.1, 1.2])
def test_a_path_of_each_velocity_costs_nothing_where_it_is_free(velocity: float) -> None:
    matrix = np.ones((30, 40), np.float32)
    middle = (15, 18)
    for step in range(-D_S // 2, D_S // 2 + 1):
        matrix[middle[0] + step, middle[1] + int(np.floor(velocity * step + 0.5))] = 0
    costs = path_costs(matrix)
    assert costs[middle] == 0
    assert np.count_nonzero(costs == 0) == 1
    assert costs[0, 39] == 1


def test_paths_end_with_the_queries_and_stay_at_the_last_reference() -> None:
    matrix = np.ones((8, 6), np.float32)
    matrix[0, 0], matrix[1, 1], matrix[2, 2], matrix[3, 3], matrix[4, 4], matrix[5, 5] = 0, 0, 0, 0, 0, 0
    costs = path_costs(matrix)
    assert costs[0, 0] == 0  # its queries 0 to 5 lie on the diagonal; none before it
    matrix[6, 5], matrix[7, 5] = 0, 0
    assert path_costs(matrix)[5, 5] == 0  # queries 6 and 7 find the references at their end


def test_the_score_is_the_rival_over_the_cost() -> None:
    costs = np.full((1, 30), 6, np.float32)
    costs[0, 10], costs[0, 10 + R_WINDOW // 2], costs[0, 25] = 2, 3, 4
    scores = distinctness(costs)
    assert scores[0, 10] == pytest.approx(4 / 2, rel=1e-5)  # the 3 is of the same place
    assert scores[0, 25] == pytest.approx(1)
    assert scores[0, 0] == pytest.approx(4 / 6, rel=1e-5)
    assert (np.argsort(-scores[0], kind="stable") == np.argsort(costs[0], kind="stable")).all()


def test_short_traverses_and_free_paths_have_finite_scores() -> None:
    assert np.isfinite(distinctness(np.array([[0, 0, 0]], np.float32))).all()
    system = SeqSlam()
    blank = system.describe(np.zeros((48, 64, 3), np.uint8))
    assert system.index([blank]).score([blank]).tolist() == [[1.0]]


def view(place: float, generator: np.random.Generator, noise: float) -> Pixels:
    """What a camera sees at a place along a wall with a random pattern, with noise of its own."""
    wall = cv2.GaussianBlur(np.random.default_rng(7).normal(0, 1, (32, 900)), (0, 0), 4)
    start = round(4 * place)
    grey = 128 + 30 / wall.std() * wall[:, start : start + 64] + generator.normal(0, noise, (32, 64))
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


@pytest.mark.thorough
@pytest.mark.parametrize("velocity", [0.85, 1.0, 1.15])
def test_a_drive_of_known_velocity_is_found_through_noise(velocity: float) -> None:
    generator = np.random.default_rng(11)
    places = 20 + velocity * np.arange(60)
    system = SeqSlam()
    assert system.sequential
    references = [system.describe(view(place, generator, 0)) for place in range(120)]
    queries = [system.describe(view(place, generator, 160)) for place in places]
    found = system.index(references).score(queries).argmax(axis=1)
    alone = differences(stack(queries, "patches"), stack(references, "patches")).argmin(axis=1)

    inner = slice(D_S // 2, -D_S // 2)  # with whole sequences
    assert np.mean(np.abs(found - places)[inner] <= 1) > 0.95
    assert np.mean(np.abs(alone - places)[inner] <= 1) < 0.8  # a single frame does not tell
