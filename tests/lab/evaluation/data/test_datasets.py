from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from core.errors import InvalidGroundTruth, InvalidTraverse
from lab.evaluation.data.datasets import find_dataset, open_dataset
from lab.evaluation.data.presets import DATASETS, THESIS, Dataset
from lab.evaluation.data.rules import groups
from tests.lab.evaluation.lookup import write_images

EVAL = Path(__file__).parents[5] / "shared/datasets/eval"


def made(folder: Path, dataset: Dataset, references: int, queries: int) -> Path:
    write_images(folder / dataset.references[0], range(references))
    write_images(folder / dataset.queries[0], range(queries))
    return folder


def test_the_thesis_sizes() -> None:
    """Tables 2.2 and 2.3."""
    found = {
        dataset.name: (size.queries, size.references, size.answerable, size.kept)
        for dataset in DATASETS
        if (size := dataset.sizes) is not None and size.source == THESIS
    }
    assert found == {
        "berlin-a100": (81, 85, 70, 64),
        "berlin-halenseestrasse": (67, 157, 50, 138),
        "berlin-kudamm": (222, 201, 166, 151),
        "gardens-point": (200, 200, 152, 150),
        "synthesized-nordland": (1622, 1622, 1221, 1217),
        "st-lucia": (1249, 1249, None, None),
        "spedtest": (607, 1821, None, None),
    }


def test_every_name_is_found_and_no_other() -> None:
    assert [find_dataset(dataset.name) for dataset in DATASETS] == list(DATASETS)
    with pytest.raises(InvalidTraverse, match="no data set 'kitti'; there are gardens-point, "):
        find_dataset("kitti")


def test_traverses_come_in_natural_order_with_their_tolerance(tmp_path: Path) -> None:
    dataset = find_dataset("gardens-point")
    pair = open_dataset(dataset, made(tmp_path, dataset, 12, 12))
    assert [path.name for path in pair.references] == [f"{n}.png" for n in range(12)]
    assert pair.references[0].parent.name == "night_right" and pair.queries[0].parent.name == "day_left"
    assert pair.truth[5].tolist() == [2, 3, 4, 5, 6, 7, 8]
    assert pair.retained.tolist() == list(range(12))
    assert pair.name == "Gardens Point Walking"
    assert "The thesis counts 200 queries and 200 references" in pair.notes[0]
    assert f"(188 queries and 188 references are missing in {tmp_path})" in pair.notes[0]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "retained", "answerable"),
    [("gardens-point", 150, 153), ("synthesized-nordland", 1217, 1221)],
)
def test_reduced_references_reach_the_thesis_counts(tmp_path: Path, name: str, retained: int, answerable: int) -> None:
    """With ±3 frames no contiguous run leaves exactly 152 of Gardens Point's queries: 153 is the nearest."""
    dataset = find_dataset(name)
    assert dataset.sizes is not None
    folder = made(tmp_path, dataset, dataset.sizes.references, dataset.sizes.queries)
    pair = open_dataset(dataset, folder, reduced=True, seed=3)
    assert len(pair.retained) == retained == dataset.sizes.kept
    assert len(pair.queries) - pair.negatives() == answerable
    gone = np.setdiff1d(np.arange(len(pair.references)), pair.retained)
    assert (np.diff(gone) == 1).all()
    assert "which run is our choice, drawn with the seed 3" in pair.notes[-1]
    assert pair.retained.tolist() == open_dataset(dataset, folder, reduced=True, seed=3).retained.tolist()


def test_reduced_references_need_the_thesis_traverses(tmp_path: Path) -> None:
    gardens = find_dataset("gardens-point")
    with pytest.raises(InvalidTraverse, match="for 200 queries and 200 references; here are 12 and 12"):
        open_dataset(gardens, made(tmp_path / "g", gardens, 12, 12), reduced=True)
    nordland = find_dataset("nordland")
    with pytest.raises(InvalidTraverse, match="no reduced references of Nordland; use --limit-references"):
        open_dataset(nordland, made(tmp_path / "n", nordland, 12, 12), reduced=True)


SIDE_BY_SIDE = [dataset for dataset in DATASETS if dataset.references]


@pytest.mark.parametrize("dataset", SIDE_BY_SIDE, ids=lambda dataset: dataset.name)
def test_a_missing_folder_is_named(tmp_path: Path, dataset: Dataset) -> None:
    with pytest.raises(InvalidTraverse, match=re.escape(str(tmp_path / dataset.references[0]))):
        open_dataset(dataset, tmp_path)
    write_images(tmp_path / dataset.references[0], range(3))
    with pytest.raises(InvalidTraverse, match="its queries are expected in the folder") as caught:
        open_dataset(dataset, tmp_path)
    assert str(tmp_path / dataset.queries[0]) in str(caught.value)
    (tmp_path / dataset.queries[0]).mkdir()
    with pytest.raises(InvalidTraverse, match="holds no image"):
        open_dataset(dataset, tmp_path)


def test_a_missing_truth_is_named(tmp_path: Path) -> None:
    corridor = find_dataset("corridor")
    with pytest.raises(InvalidGroundTruth, match=r"its truth is expected in the file .*ground_truth\.csv"):
        open_dataset(corridor, made(tmp_path / "c", corridor, 3, 3))
    lucia = find_dataset("st-lucia")
    with pytest.raises(InvalidGroundTruth, match=r"0\.png has no pose: .* Or put its truth into .*ground_truth\.csv"):
        open_dataset(lucia, made(tmp_path / "s", lucia, 3, 3))


def test_a_truth_file_beside_the_traverses_is_taken(tmp_path: Path) -> None:
    dataset = find_dataset("gardens-point")
    made(tmp_path, dataset, 3, 2)
    (tmp_path / "ground_truth.csv").write_text("0,2\n1,0\n")
    assert [true.tolist() for true in open_dataset(dataset, tmp_path).truth] == [[2], [0]]


def test_berlin_takes_the_nearest_geotag(tmp_path: Path) -> None:
    dataset = find_dataset("berlin-kudamm")
    made(tmp_path, dataset, 8, 2)
    rows = "".join(f"{n}.png,{52.5 + n * 1e-4},13.3\n" for n in range(8))
    (tmp_path / "berlin_kudamm_1/places.csv").write_text("file,latitude,longitude\n" + rows)
    (tmp_path / "berlin_kudamm_2/places.csv").write_text(
        "file,latitude,longitude\n0.png,52.50052,13.3\n1.png,52.4,13.3\n"
    )
    assert [true.tolist() for true in open_dataset(dataset, tmp_path).truth] == [[3, 4, 5, 6, 7], [0, 1, 2]]


def test_spedtest_has_groups_of_references(tmp_path: Path) -> None:
    dataset = find_dataset("spedtest")
    pair = open_dataset(dataset, made(tmp_path, dataset, 6, 2))
    assert [true.tolist() for true in pair.truth] == [[0, 1, 2], [3, 4, 5]]
    with pytest.raises(InvalidTraverse, match="7 references cannot be shared out evenly over 2 queries"):
        groups()(pair.queries, [*pair.references, tmp_path / "7.png"])


@pytest.mark.skipif(not EVAL.is_dir(), reason="the traverses of ../shared/datasets are not here")
@pytest.mark.parametrize(
    ("name", "folder", "queries", "references", "true"),
    [("corridor", "corridor", 111, 111, [0, 1, 2]), ("lip6", "lip6_outdoor", 455, 608, [146, 147, 148, 149, 150])],
)
def test_the_sets_at_hand_open(name: str, folder: str, queries: int, references: int, true: list[int]) -> None:
    pair = open_dataset(find_dataset(name), EVAL / folder)
    assert (len(pair.queries), len(pair.references)) == (queries, references)
    assert pair.truth[0].tolist() == true
    assert pair.negatives() == 0 and pair.notes == []
