from __future__ import annotations

import cv2
import numpy as np

from core.frames.traverses import tolerance_truth
from lab.evaluation import judge
from lab.evaluation.report.matrix import RIGHT, TRUTH, WRONG, heat_file, layers, matrix_file, png, true_cells
from lab.evaluation.report.theme import rgb


def test_true_cells_of_kept_references() -> None:
    truth = [np.array([0, 1]), np.array([2]), np.array([], np.int64)]
    cells = true_cells(truth, np.array([1, 2, 5]))
    assert cells.tolist() == [[True, False, False], [False, True, False], [False, False, False]]


def test_small_matrix_by_hand() -> None:
    retained, truth = np.array([0, 2]), tolerance_truth(2, 3, 0)
    scores = np.array([[1.0, 0.0], [0.0, 1.0]], np.float32)
    drawn = layers(scores, true_cells(truth, retained), retained, judge(scores, retained, truth), longest=20)
    assert drawn.heat.shape == (20, 20)
    assert not drawn.shrunk
    assert (drawn.heat[:10, :10] == 255).all()
    assert (drawn.heat[:10, 10:] == 0).all()
    # Query 0 is true at reference 0, in the first column; reference 1 was not retained.
    opaque = drawn.truth[..., 3] == 255
    assert opaque[:10, :10].sum() == 36, "the edge of a square of ten"
    assert not opaque[1:9, 1:9].any()
    assert not opaque[:, 10:].any()
    assert tuple(drawn.truth[0, 0, :3]) == rgb(TRUTH)
    # Query 0 is right; query 1 finds reference 2, in the second column, and is wrong.
    assert tuple(drawn.matches[5, 5, :3]) == rgb(RIGHT)
    assert tuple(drawn.matches[15, 15, :3]) == rgb(WRONG)
    assert not drawn.matches[5, 15].any()
    assert not drawn.matches[[0, 9]].any(), "a match stays inside its cell"


def test_no_true_cell_is_lost_in_a_large_matrix() -> None:
    count = 2000
    retained, truth = np.arange(count), tolerance_truth(count, count, 0)
    scores = np.eye(count, dtype=np.float32)
    drawn = layers(scores, true_cells(truth, retained), retained, judge(scores, retained, truth), longest=200)
    assert drawn.heat.shape == (200, 200)
    assert drawn.shrunk
    assert (drawn.truth[np.arange(200), np.arange(200), 3] == 255).all()
    assert drawn.matches[..., 3].any(axis=1).all()
    data, media = heat_file(drawn)
    assert media == "image/jpeg"
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert decoded is not None
    assert np.abs(decoded.astype(int) - drawn.heat).mean() < 12


def test_matrix_of_one_value() -> None:
    retained, truth = np.arange(3), tolerance_truth(2, 3, 0)
    scores = np.full((2, 3), 0.5, np.float32)
    drawn = layers(scores, true_cells(truth, retained), retained, judge(scores, retained, truth))
    assert (drawn.heat == 0).all()


def test_long_and_narrow_matrix() -> None:
    retained, truth = np.array([0]), tolerance_truth(500, 1, 0)
    scores = np.random.default_rng(0).random((500, 1)).astype(np.float32)
    drawn = layers(scores, true_cells(truth, retained), retained, judge(scores, retained, truth), longest=100)
    assert drawn.heat.shape == (100, 1)
    assert cv2.imdecode(np.frombuffer(matrix_file("HOG", drawn, (500, 1)), np.uint8), cv2.IMREAD_COLOR) is not None


def test_files_decode_to_the_layers() -> None:
    retained, truth = np.arange(3), tolerance_truth(3, 3, 0)
    scores = np.eye(3, dtype=np.float32)
    drawn = layers(scores, true_cells(truth, retained), retained, judge(scores, retained, truth), longest=30)
    heat = cv2.imdecode(np.frombuffer(heat_file(drawn)[0], np.uint8), cv2.IMREAD_UNCHANGED)
    matches = cv2.imdecode(np.frombuffer(png(drawn.matches), np.uint8), cv2.IMREAD_UNCHANGED)
    assert heat is not None
    assert matches is not None
    assert np.array_equal(heat, drawn.heat)
    assert np.array_equal(matches[..., [2, 1, 0, 3]], drawn.matches)
