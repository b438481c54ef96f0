from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from core.errors import InvalidGroundTruth
from lab.evaluation.data import object_arrays
from lab.evaluation.data.truth_files import (
    Reader,
    read_array,
    read_masks,
    read_matrix,
    read_positions,
    read_table,
    truth_of_variables,
)
from tests.lab.evaluation.data.trees import objects

QUERIES = [Path(f"query/{number}.jpg") for number in range(3)]
REFERENCES = [Path(f"ref/{number}.jpg") for number in range(5)]


def truths(read: Reader, path: Path) -> list[list[int]]:
    return [true.tolist() for true in read(path, QUERIES, REFERENCES)]


@pytest.mark.parametrize("old", [False, True], ids=["numpy", "python-2"])
def test_lists_of_references(tmp_path: Path, old: bool) -> None:
    """As VPR-Bench keeps them: lists, arrays and numbers; those beyond the traverse do not count."""
    objects(tmp_path / "t.npy", [[0, 1], np.array([4, 5, -1]), np.int64(2)], old=old)
    assert truths(read_array, tmp_path / "t.npy") == [[0, 1], [4], [2]]


def test_references_alone_and_plain_numbers(tmp_path: Path) -> None:
    rows = np.empty(3, object)
    rows[:] = [np.array([0]), [1, 2], 4]
    np.save(tmp_path / "lists.npy", rows)
    np.save(tmp_path / "numbers.npy", np.array([[0, 1], [2, 2], [3, 4]]))
    assert truths(read_array, tmp_path / "lists.npy") == [[0], [1, 2], [4]]
    assert truths(read_array, tmp_path / "numbers.npy") == [[0, 1], [2], [3, 4]]


class Hostile:
    """Runs a command where it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, (f"touch {self.folder / 'ran'}",)


@pytest.mark.parametrize("old", [False, True], ids=["numpy", "python-2"])
def test_nothing_in_a_file_is_run(tmp_path: Path, old: bool) -> None:
    objects(tmp_path / "t.npy", [[0], Hostile(tmp_path), [2]], old=old)
    with pytest.raises(InvalidGroundTruth, match=r"it holds a call of \w+.system, as no list of references does"):
        read_array(tmp_path / "t.npy", QUERIES, REFERENCES)
    objects(tmp_path / "t.npy", [[0], Path("a"), [2]], old=old)
    with pytest.raises(InvalidGroundTruth, match="it holds a call of pathlib"):
        read_array(tmp_path / "t.npy", QUERIES, REFERENCES)
    assert not (tmp_path / "ran").exists()


@pytest.mark.thorough
def test_any_damage_is_a_clear_error(tmp_path: Path) -> None:
    """Cut anywhere, or with any byte changed, a file gives lists or is refused, and nothing else."""
    path, random = tmp_path / "t.npy", np.random.default_rng(5)
    objects(path, [[0, 1], np.array([4]), np.int64(2)])
    whole = path.read_bytes()
    damaged = [whole[:size] for size in range(0, len(whole), 3)]
    for _ in range(600):
        changed = bytearray(whole)
        changed[int(random.integers(len(whole)))] = int(random.integers(256))
        damaged.append(bytes(changed))
    refused = 0
    for data in damaged:
        path.write_bytes(data)
        try:
            read_array(path, QUERIES, REFERENCES)
        except InvalidGroundTruth:
            refused += 1
    assert refused > 200


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([[0], [1]], "has 2 rows, and there are 3 queries"),
        ([[0], [1], [2], [3]], "names the query 3, and 3 images are there: some are missing"),
        ([[0], ["one"], [2]], "something that is no whole number"),
        ([[0.5], [1], [2]], "something that is no whole number"),
        ([[9], [9], [9]], "names no true reference"),
    ],
)
def test_lists_that_do_not_fit_are_refused(tmp_path: Path, rows: list[list[object]], said: str) -> None:
    objects(tmp_path / "t.npy", rows)
    with pytest.raises(InvalidGroundTruth, match=said):
        read_array(tmp_path / "t.npy", QUERIES, REFERENCES)


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    objects(tmp_path / "t.npy", [[0], [1], [2]])
    monkeypatch.setattr(object_arrays, "MAX_BYTES", 100)
    with pytest.raises(InvalidGroundTruth, match="more than 100 bytes"):
        read_array(tmp_path / "t.npy", QUERIES, REFERENCES)
    with pytest.raises(InvalidGroundTruth, match="cannot be read"):
        read_array(tmp_path / "none.npy", QUERIES, REFERENCES)


def test_a_table_says_its_line(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("Serial No,Query,Reference\n0,1262,1\n1,1263,4\n\n")
    assert truths(read_table(0, 2, 1), path) == [[0, 1, 2], [3, 4], []]
    for text, said in (
        ("0,1\n", "line 1: there are 2 columns"),
        ("a,b,c\n0,1,x\n", "line 2: 'x' is not the number of an image"),
        ("0,1,7\n", "names the reference 7, and 5 images are there"),
        ("a,b,c\n", "names no true reference"),
        ("\x00,\xff", "line 1: there are 2 columns"),
    ):
        path.write_text(text)
        with pytest.raises(InvalidGroundTruth, match=said):
            truths(read_table(0, 2, 1), path)


@pytest.mark.thorough
def test_a_file_of_matlab(tmp_path: Path) -> None:
    """Each is read in a process of its own, which takes a second."""
    path, cell = tmp_path / "t.mat", np.empty((3, 1), object)
    cell[:, 0] = [np.array([[1, 2]]), np.array([[3]]), np.array([[5]])]
    savemat(path, {"about": "references of each query", "truth": cell})
    assert truths(read_matrix, path) == [[0, 1], [2], [4]]
    path.write_bytes(path.read_bytes()[:150])
    with pytest.raises(InvalidGroundTruth, match=r"The truth cannot be read: t\.mat"):
        truths(read_matrix, path)


@pytest.mark.parametrize(
    ("values", "true"),
    [
        ([[1, 0, 0, 0, 0], [0, 0, 0, 0, 1], [0, 0, 1, 1, 0]], [[0], [4], [2, 3]]),  # queries by references
        ([[1, 0, 0], [0, 0, 0], [0, 0, 1], [0, 0, 1], [0, 1, 0]], [[0], [4], [2, 3]]),  # and turned
        ([[2, 5], [1, 1], [3, 2]], [[0], [4], [1]]),  # pairs of a query and its reference
        ([[1, 2], [3, 0], [5, 0]], [[0, 1], [2], [4]]),  # filled up with 0
        ([[0, 1], [2, 3], [4, 4]], [[0, 1], [2, 3], [4]]),  # counted from 0
        ([[5, 3, 1]], [[4], [2], [0]]),  # a row in place of a column
    ],
)
def test_matrices_of_matlab(values: list[list[int]], true: list[list[int]]) -> None:
    found = truth_of_variables({"about": "text", "truth": np.array(values)}, Path("t.mat"), 3, 5)
    assert [one.tolist() for one in found] == true


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (np.array([[1, 2], [3, 0], [9, 0]]), "names the reference 9, and 5 images are there"),
        (np.array([[1.5], [2], [3]]), "no row of whole numbers"),
        (np.array([[np.inf], [2], [3]]), "not finite"),
        (np.zeros((3, 5)), "names no true reference"),
        (np.zeros((7, 2)), r"holds no matrix for 3 queries and 5 references, only truth \(7, 2\)"),
        (["a", "b", "c"], "a cell of something other than numbers"),
    ],
)
def test_other_matrices_of_matlab_are_refused(value: object, said: str) -> None:
    with pytest.raises(InvalidGroundTruth, match=said):
        truth_of_variables({"truth": value}, Path("t.mat"), 3, 5)


def test_masks_and_positions_of_numpy(tmp_path: Path) -> None:
    hard = np.eye(5, 3, dtype=bool)
    np.savez(tmp_path / "GT.npz", GThard=hard, GTsoft=hard | np.eye(5, 3, k=-1, dtype=bool))
    truth, excluded = read_masks(tmp_path / "GT.npz", QUERIES, REFERENCES)
    assert [true.tolist() for true in truth] == [[0], [1], [2]]
    assert [out.tolist() for out in excluded] == [[1], [2], [3]]
    with pytest.raises(InvalidGroundTruth, match=r"GThard has the shape \(5, 3\); 4 references and 3 queries are here"):
        read_masks(tmp_path / "GT.npz", QUERIES, REFERENCES[:4])
    with pytest.raises(InvalidGroundTruth, match="holds no utmQ"):
        read_positions(tmp_path / "GT.npz")
    np.savez(tmp_path / "p.npz", utmQ=np.zeros((2, 2)), utmDb=np.array([[0, np.nan]]), posDistThr=5)
    with pytest.raises(InvalidGroundTruth, match="not rows of two finite numbers"):
        read_positions(tmp_path / "p.npz")
    np.savez(tmp_path / "o.npz", utmQ=np.array([None], object))
    with pytest.raises(InvalidGroundTruth, match=r"is not a \.npz file of plain numbers"):
        read_positions(tmp_path / "o.npz")
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(InvalidGroundTruth, match=r"x\.npz"):
        read_positions(tmp_path / "x.npz")
