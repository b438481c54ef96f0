from __future__ import annotations

from pathlib import Path

import pytest

from core.errors import InvalidGroundTruth
from core.places import Pose
from lab.evaluation.data.poses import nearest_truth, read_poses, within_truth
from tests.core.frames.test_exif import EIFFEL, GPS, photograph


def at(x: float, y: float = 0.0, heading: float | None = None) -> Pose:
    return Pose(x=x, y=y, heading=heading)


def images(folder: Path, *names: str) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"")
    return [folder / name for name in names]


def test_within_metres_by_hand() -> None:
    truth = within_truth([at(0), at(9, 3), at(50)], [at(0), at(3), at(9, -1), at(4, 3)], 5.0, None)
    # Query 0: 0, 3, 9.06 and exactly 5 metres; query 1: 9.5, 6.7, 4, 5; query 2: all far.
    assert [true.tolist() for true in truth] == [[0, 1, 3], [2, 3], []]


def test_headings_count_around_the_circle() -> None:
    references = [at(0, heading=10), at(0, heading=350), at(0, heading=180), at(0, heading=41)]
    truth = within_truth([at(0, heading=0), at(0, heading=340)], references, 1.0, 30.0)
    assert [true.tolist() for true in truth] == [[0, 1], [0, 1]]


def test_degrees_on_the_earth() -> None:
    # A thousandth of a degree of latitude is 111 m; of longitude, at 60 degrees north, half of it.
    here = Pose(latitude=60.0, longitude=25.0)
    north, east = Pose(latitude=60.001, longitude=25.0), Pose(latitude=60.0, longitude=25.001)
    assert [true.tolist() for true in within_truth([here], [north, east], 60.0, None)] == [[1]]
    assert [true.tolist() for true in within_truth([here], [north, east], 112.0, None)] == [[0, 1]]


def test_the_nearest_and_its_neighbours() -> None:
    references = [at(n) for n in range(6)]
    truth = nearest_truth([at(2.2), at(-4), at(9)], references, 2)
    assert [true.tolist() for true in truth] == [[0, 1, 2, 3, 4], [0, 1, 2], [3, 4, 5]]


def test_poses_that_do_not_compare_are_refused() -> None:
    with pytest.raises(InvalidGroundTruth, match="some poses are in metres"):
        within_truth([at(0)], [Pose(latitude=1, longitude=1)], 5, None)
    with pytest.raises(InvalidGroundTruth, match="without a heading"):
        within_truth([at(0, heading=1)], [at(0)], 5, 10)
    with pytest.raises(InvalidGroundTruth, match=r"within 5 m of a reference \(the nearest 8.0 m off\)"):
        within_truth([at(0)], [at(8)], 5, None)


def test_poses_of_a_list(tmp_path: Path) -> None:
    paths = images(tmp_path, "a.jpg", "b.jpg")
    (tmp_path / "places.csv").write_text("file,id,x,y,heading\nb.jpg,second,3,4,\na.jpg,first,1,2,-90\n")
    first, second = read_poses(paths)
    assert (first.x, first.y, first.heading) == (1, 2, 270)
    assert (second.x, second.y, second.heading) == (3, 4, None)


def test_poses_of_names(tmp_path: Path) -> None:
    long = "@0543256.96@4178906.70@10@S@037.75809@-122.50819@pano@@090@@@@200901@@.jpg"
    paths = images(tmp_path, long, "@10@20@.jpg")
    first, second = read_poses(paths)
    # Clockwise from north becomes counter-clockwise from east: 90 degrees from north is east.
    assert (first.x, first.y, first.heading) == (543256.96, 4178906.70, 0)
    assert (second.x, second.y, second.heading) == (10, 20, None)


def test_poses_of_the_files(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(photograph(gps=GPS))
    (pose,) = read_poses([path])
    assert (pose.latitude, pose.longitude) == pytest.approx(EIFFEL, abs=1e-7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file,x,y\na.jpg,1,2\n", "b.jpg has no pose: list it in"),
        ("file,x,y\na.jpg,1,2\nb.jpg,,\n", "b.jpg has no pose"),
        ("file,x,y\na.jpg,1,two\nb.jpg,1,1\n", "places.csv, line 2: "),
        ("file,x,y\na.jpg,1,\nb.jpg,1,1\n", "line 2: a pose in metres needs x and y"),
        ("file,latitude,longitude\na.jpg,91,2\nb.jpg,1,1\n", "line 2"),
    ],
)
def test_a_list_that_lacks_something_is_refused(tmp_path: Path, text: str, message: str) -> None:
    paths = images(tmp_path, "a.jpg", "b.jpg")
    (tmp_path / "places.csv").write_text(text)
    with pytest.raises(InvalidGroundTruth, match=message):
        read_poses(paths)


def test_images_without_any_pose_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidGroundTruth, match=r"c\.jpg has no pose"):
        read_poses(images(tmp_path, "c.jpg"))
    with pytest.raises(InvalidGroundTruth, match="has no pose"):
        read_poses(images(tmp_path / "named", "@east@north@.jpg"))
    assert read_poses([]) == []
