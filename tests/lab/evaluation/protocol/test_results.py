from __future__ import annotations

import csv
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.errors import InvalidResults
from core.judgement.curves import auc_pr
from lab.evaluation.protocol.outcomes import Outcome
from lab.evaluation.protocol.results import NOT_IN_FILE, read_results, read_similarity, results_csv, summarize_results

SCORES = st.one_of(
    st.integers(-3, 3).map(lambda n: n / 4),  # few different values, so that ties are common
    st.floats(-1e3, 1e3, width=32),
)
OUTCOMES = st.lists(
    st.builds(
        lambda retrieved, score, matched: Outcome(retrieved, score, matched, 1 if matched else 2),
        st.integers(0, 10**6),
        SCORES,
        st.booleans(),
    ),
    min_size=1,
    max_size=60,
)


def saved(folder: Path, text: str) -> Path:
    path = folder / "results.csv"
    path.write_text(text, "utf-8")
    return path


def test_results_are_one_row_a_query() -> None:
    score = float(np.float32(0.1))
    text = results_csv([Outcome(7, score, True, 1), Outcome(3, -0.25, False, None)])
    assert text == "query,retrieved,score,matched\n0,7,0.100000001,1\n1,3,-0.25,0\n"
    rows = list(csv.DictReader(text.splitlines()))
    assert np.float32(rows[0]["score"]) == np.float32(score)


@pytest.mark.parametrize("score", [1 - 1e-9, 0.1, 1e300, -5e-324])
def test_scores_of_double_precision_are_written_whole(tmp_path: Path, score: float) -> None:
    results = read_results(saved(tmp_path, results_csv([Outcome(0, score, True, 1)])))
    assert results.scores.tolist() == [score]


@pytest.mark.thorough
@given(OUTCOMES)
def test_what_is_written_is_read_back(outcomes: list[Outcome]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        results = read_results(saved(Path(folder), results_csv(outcomes)))
    assert results.query.tolist() == list(range(len(outcomes)))
    assert results.retrieved.tolist() == [outcome.retrieved for outcome in outcomes]
    assert results.matched.tolist() == [outcome.matched for outcome in outcomes]
    assert results.scores.astype(np.float32).tolist() == [np.float32(outcome.score) for outcome in outcomes]


@pytest.mark.thorough
@given(OUTCOMES, st.booleans())
def test_the_figures_are_those_of_the_outcomes(outcomes: list[Outcome], header: bool) -> None:
    """Random data, ties and one class, with and without a header."""
    rows = results_csv(outcomes).splitlines(keepends=True)
    with tempfile.TemporaryDirectory() as folder:
        figures = summarize_results("saved", read_results(saved(Path(folder), "".join(rows if header else rows[1:]))))
    matched = [outcome.matched for outcome in outcomes]
    assert figures.auc_pr == pytest.approx(auc_pr([outcome.score for outcome in outcomes], matched), abs=1e-6)
    assert figures.one_class == ("all right" if all(matched) else None if any(matched) else "none right")
    assert ("auc_pr" in figures.notes) == (len(set(matched)) == 1)
    assert (figures.right, figures.queries) == (sum(matched), len(matched))


def test_the_authors_form(tmp_path: Path) -> None:
    # No header, shuffled queries numbered from 1, many digits, "matched" as 1.0 and 0.0.
    path = saved(tmp_path, "153,458,0.5716712202865459,1.0\n62,184,0.797197172741061,1.0\n454,893,0.4624567,0.0\n")
    results = read_results(path)
    assert results.query.tolist() == [153, 62, 454]
    assert results.retrieved.tolist() == [458, 184, 893]
    assert results.matched.tolist() == [True, True, False]
    figures = summarize_results("them", results)
    assert figures.auc_pr == auc_pr(results.scores, results.matched) == 1.0
    assert figures.one_class is None
    assert figures.notes["recall_at"] == figures.notes["auc_roc"] == NOT_IN_FILE
    assert (figures.auc_roc, figures.recall_at["1"], figures.extended_precision) == (None, None, None)


def test_spaces_a_byte_order_mark_and_blank_lines_do_no_harm(tmp_path: Path) -> None:
    results = read_results(saved(tmp_path, "\ufeffQuery, Retrieved ,score,matched\r\n\r\n0, 1, 2e-1, 1\r\n"))
    assert results.scores.tolist() == [0.2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no row"),
        ("query,retrieved,score,matched\n", "holds no row"),
        ("0,1,0.5\n", "line 1: a row is 'query,retrieved,score,matched', not 3 columns"),
        ("0,1,0.5,1,9\n", "not 5 columns"),
        ("0,1,0.5,1\n1,2,nan,1\n", "line 2: 'nan' is not a score"),
        ("0,1,high,1\n", "'high' is not a score"),
        ("0,1,inf,1\n", "'inf' is not a score"),
        ("0,1,0.5,yes\n", "matched is 1 or 0, not 'yes'"),
        ("0,1,0.5,2\n", "matched is 1 or 0"),
        ("a.jpg,1,0.5,1\n", "'a.jpg' is not the index of a query"),
        ("0,-1,0.5,1\n", "'-1' is not the index of a reference"),
        ("0,1,0.5,1\n0,2,0.4,0\n", "more than one row of query 0"),
        ("0,1,0.5,1\nquery,retrieved,score,matched\n", "line 2"),
    ],
)
def test_a_malformed_file_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InvalidResults, match=message):
        read_results(saved(tmp_path, text))


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InvalidResults, match="not a CSV file"):
        read_results(path)
    with pytest.raises(InvalidResults, match="cannot be read"):
        read_results(tmp_path / "missing.csv")


# Similarity files


MATRIX = np.array([[0.1, 0.9, 0.3], [0.7, 0.2, 0.4]])


def saved_matrix(folder: Path, array: np.ndarray) -> Path:
    path = folder / "matrix.npy"
    np.save(path, array)
    return path


@pytest.mark.parametrize("kind", [np.float64, np.float32, np.float16])
def test_rows_are_queries(tmp_path: Path, kind: type) -> None:
    scores = read_similarity(saved_matrix(tmp_path, MATRIX.astype(kind)))
    assert scores.dtype == np.float64
    assert np.allclose(scores, MATRIX, atol=1e-3)


def test_scores_are_not_rounded(tmp_path: Path) -> None:
    close = np.array([[1 - 2e-9, 1 - 1e-9]])
    assert read_similarity(saved_matrix(tmp_path, close)).tolist() == close.tolist()


def test_rows_are_references_where_that_is_said(tmp_path: Path) -> None:
    scores = read_similarity(saved_matrix(tmp_path, MATRIX.T), transposed=True)
    assert scores.shape == (2, 3) and scores.flags.c_contiguous
    assert np.allclose(scores, MATRIX)


def test_integers_are_scores_too(tmp_path: Path) -> None:
    assert read_similarity(saved_matrix(tmp_path, np.array([[3, 1]]))).tolist() == [[3.0, 1.0]]


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
        read_similarity(saved_matrix(tmp_path, array))


def test_a_pickled_array_is_never_read(tmp_path: Path) -> None:
    path = saved_matrix(tmp_path, np.array([[1.0, {}]], dtype=object))
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
