from pathlib import Path

import numpy as np
import pytest

from core.errors import InvalidGroundTruth, InvalidTraverse
from core.frames.traverses import (
    find_images,
    find_images_below,
    natural_key,
    read_ground_truth,
    read_retained_references,
    tolerance_truth,
)


def test_images_come_in_natural_order_without_subfolders(tmp_path: Path) -> None:
    for name in ["10.jpg", "2.jpg", "1.JPEG", "notes.txt", ".hidden.jpg", "frame10.png", "frame9.webp", "3.bmp"]:
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "deeper").mkdir()
    (tmp_path / "deeper" / "0.jpg").write_bytes(b"")
    (tmp_path / "folder.jpg").mkdir()

    found = [path.name for path in find_images(tmp_path)]

    # The BMP cannot be decoded and will stop the run: left out, it would shift the indices.
    assert found == ["1.JPEG", "2.jpg", "3.bmp", "10.jpg", "frame9.webp", "frame10.png"]


def test_images_below_a_directory_come_in_natural_order(tmp_path: Path) -> None:
    for name in ["b/2.jpg", "b/10.jpg", "a10/1.jpg", "a9/deep/1.png", "3.jpg", ".hidden/1.jpg", "b/notes.txt"]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "b" / "again").symlink_to(tmp_path)  # followed, this would never end

    found = [path.relative_to(tmp_path).as_posix() for path in find_images_below(tmp_path)]

    assert found == ["3.jpg", "a9/deep/1.png", "a10/1.jpg", "b/2.jpg", "b/10.jpg"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InvalidTraverse, match="holds no image"):
        find_images_below(tmp_path / "empty")
    with pytest.raises(InvalidTraverse, match="cannot be read"):
        find_images_below(tmp_path / "missing")


def test_equal_numbers_are_ordered_by_spelling() -> None:
    names = ["07.jpg", "7.jpg", "007.jpg", "8.jpg", "a1b10", "a1b9"]
    assert sorted(names, key=natural_key) == ["007.jpg", "07.jpg", "7.jpg", "8.jpg", "a1b9", "a1b10"]


def test_a_directory_must_exist_and_hold_an_image(tmp_path: Path) -> None:
    with pytest.raises(InvalidTraverse, match=r"holds no image \(\.jpeg, .*\.webp, .*\.bmp, .*\.tiff\)"):
        find_images(tmp_path)
    with pytest.raises(InvalidTraverse, match="cannot be read as a directory"):
        find_images(tmp_path / "missing")
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(InvalidTraverse, match="cannot be read as a directory"):
        find_images(file)


def test_tolerance_is_cut_at_both_ends() -> None:
    truth = tolerance_truth(5, 4, 1)
    assert [list(true) for true in truth] == [[0, 1], [0, 1, 2], [1, 2, 3], [2, 3], [3]]
    assert [list(true) for true in tolerance_truth(3, 1, 0)] == [[0], [], []]


@pytest.mark.parametrize("header", ["", "query,reference\n", "\ufeffquery, Reference\r\n"])
def test_ground_truth_takes_several_rows_per_query(tmp_path: Path, header: str) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(header + "0,2\n0,1\n\n2, 0\n0,1\n", encoding="utf-8")
    truth = read_ground_truth(path, 3, 3)
    assert [list(true) for true in truth] == [[1, 2], [], [0]]
    assert truth[1].dtype == np.int64


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,1\n0\n", "line 2: a row is 'query,reference'"),
        ("0,1,2\n", "line 1: a row is"),
        ("0,1\nquery,reference\n", "line 2: 'query' is not the index of a query"),
        ("0,-1\n", "'-1' is not the index of a reference"),
        ("0,1.0\n", "'1.0' is not the index"),
        ("3,0\n", "there is no query 3; the 3 images"),
        ("0,4\n", "there is no reference 4; the 4 images"),
        ("query,reference\n", "names no true reference"),
        ("", "names no true reference"),
    ],
)
def test_a_wrong_ground_truth_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(text)
    with pytest.raises(InvalidGroundTruth, match=message):
        read_ground_truth(path, 3, 4)


def test_a_ground_truth_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InvalidGroundTruth, match="is not text"):
        read_ground_truth(path, 1, 1)
    with pytest.raises(InvalidGroundTruth, match="cannot be read"):
        read_ground_truth(tmp_path / "missing.csv", 1, 1)


def test_kept_references_are_sorted_and_counted_once(tmp_path: Path) -> None:
    path = tmp_path / "kept.txt"
    path.write_text("4\n0\n\n 2 \n4\n")
    kept = read_retained_references(path, 5)
    assert kept.tolist() == [0, 2, 4]
    with pytest.raises(InvalidGroundTruth, match="no reference 4"):
        read_retained_references(path, 4)
    path.write_text("\n")
    with pytest.raises(InvalidGroundTruth, match="lists no reference"):
        read_retained_references(path, 4)
    path.write_text("1,2\n")
    with pytest.raises(InvalidGroundTruth, match="'1,2' is not the index"):
        read_retained_references(path, 4)
