from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.errors import InvalidResults
from core.frames.traverses import tolerance_truth
from lab.evaluation.cache import EvaluationCache
from lab.evaluation.data.pairs import TraversePair
from lab.evaluation.elsewhere import read_others
from lab.evaluation.run import compare_systems
from lab.evaluation.subject import Training
from tests.lab.evaluation.lookup import Lookup, load, write_images


class Quiet:
    def begin(self, system: str, steps: int) -> None: ...
    def advance(self) -> None: ...
    def end(self) -> None: ...


@pytest.fixture
def pair(tmp_path: Path) -> TraversePair:
    references, queries = write_images(tmp_path / "r", range(4)), write_images(tmp_path / "q", range(4))
    truth = tolerance_truth(4, 4, 0)
    excluded = [np.array([1]), *(np.empty(0, np.int64) for _ in range(3))]
    return TraversePair("made", references, queries, truth, np.arange(4), [], excluded, "gardens-point.anyloc")


def test_others_stand_beside_what_was_measured(pair: TraversePair, tmp_path: Path) -> None:
    """The other system prefers reference 1 for query 0, which is left out, and 2 for query 3, which is wrong."""
    folder = tmp_path / "others"
    folder.mkdir()
    scores = np.eye(4, dtype=np.float32)
    scores[0, 1], scores[3, 2] = 2, 3
    np.save(folder / "Theirs.npy", scores)
    (folder / "notes.txt").write_text("no matrix")
    (other,) = read_others(folder, pair)
    assert (other.about.name, other.about.title, other.elsewhere) == ("Theirs", "Theirs (elsewhere)", True)
    assert [one.matched for one in other.outcomes] == [True, True, True, False]
    assert other.identity == other.evaluation.encoder == "Theirs (computed elsewhere)"
    assert other.bytes_per_place is None and set(other.milliseconds.values()) == {None}

    ours = Lookup(np.eye(4, dtype=np.float32))
    training = Training(pair.references, "none")
    found = compare_systems([ours], pair, training, load, EvaluationCache(None), Quiet(), others=[other])
    assert [(run.about.name, run.elsewhere) for run in found.runs] == [("lookup", False), ("Theirs", True)]
    assert [one.system for one in found.published] == ["AnyLoc", "MixVPR"]
    assert found.published[0].recall_at == (0.955, 0.995) and "Table III" in found.published[0].source


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (np.zeros((4, 5), np.float32), "Theirs.npy has 4 rows and 5 columns; made has 4 queries and 4 references"),
        (np.full((4, 4), np.nan), "not finite"),
        (np.array([[None]], object), "not a plain .npy array"),
    ],
)
def test_a_matrix_that_does_not_fit_is_refused(
    pair: TraversePair, tmp_path: Path, matrix: np.ndarray, said: str
) -> None:
    np.save(tmp_path / "Theirs.npy", matrix)
    with pytest.raises(InvalidResults, match=said):
        read_others(tmp_path, pair)


def test_a_folder_without_a_matrix_is_refused(pair: TraversePair, tmp_path: Path) -> None:
    with pytest.raises(InvalidResults, match="holds no matrix of similarities"):
        read_others(tmp_path / "r", pair)
    with pytest.raises(InvalidResults, match="cannot be read"):
        read_others(tmp_path / "none", pair)
