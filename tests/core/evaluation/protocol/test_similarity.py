from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.errors import InvalidResults
from core.evaluation.protocol.similarity import read_similarity

MATRIX = np.array([[0.1, 0.9, 0.3], [0.7, 0.2, 0.4]])


def saved(folder: Path, array: np.ndarray) -> Path:
    path = folder / "matrix.npy"
    np.save(path, array)
    return path


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.float16])
def test_rows_are_queries(tmp_path: Path, kind: type) -> None:
    scores = read_similarity(saved(tmp_path, MATRIX.astype(kind)))
    assert scores.dtype == np.float64
    assert np.allclose(scores, MATRIX, atol=1e-3)


def test_scores_are_not_rounded(tmp_path: Path) -> None:
    close = np.array([[1 - 2e-9, 1 - 1e-9]])
    assert read_similarity(saved(tmp_path, close)).tolist() == close.tolist()


def test_rows_are_references_where_that_is_said(tmp_path: Path) -> None:
    scores = read_similarity(saved(tmp_path, MATRIX.T), transposed=True)
    assert scores.shape == (2, 3) and scores.flags.c_contiguous
    assert np.allclose(scores, MATRIX)


def test_integers_are_scores_too(tmp_path: Path) -> None:
    assert read_similarity(saved(tmp_path, np.array([[3, 1]]))).tolist() == [[3.0, 1.0]]


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros(3), "no matrix"),
        (np.zeros((2, 2, 2)), "no matrix"),
        (np.zeros((0, 2)), "no matrix"),
        (np.array([["a", "b"]]), "not similarities"),
        (np.array([[1j]]), "not similarities"),
        (np.array([[0.1, np.nan]]), "not finite"),
        (np.array([[0.1, np.inf]]), "not finite"),
    ],
)
def test_what_is_no_matrix_of_scores_is_refused(tmp_path: Path, array: np.ndarray, message: str) -> None:
    with pytest.raises(InvalidResults, match=message):
        read_similarity(saved(tmp_path, array))


def test_a_pickled_array_is_never_read(tmp_path: Path) -> None:
    path = saved(tmp_path, np.array([[1.0, {}]], dtype=object))
    with pytest.raises(InvalidResults, match="save the matrix alone"):
        read_similarity(path)


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidResults, match="cannot be read"):
        read_similarity(tmp_path / "missing.npy")
    (tmp_path / "text.npy").write_text("0.1,0.2")
    with pytest.raises(InvalidResults, match="not a plain"):
        read_similarity(tmp_path / "text.npy")
    (tmp_path / "empty.npy").write_bytes(b"")
    with pytest.raises(InvalidResults):
        read_similarity(tmp_path / "empty.npy")
    np.savez(tmp_path / "many.npz", a=MATRIX)
    with pytest.raises(InvalidResults, match="no matrix"):
        read_similarity(tmp_path / "many.npz")
