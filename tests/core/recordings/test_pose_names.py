"""Poses in the names of files, and folders of such files."""

from __future__ import annotations

from pathlib import Path

import pytest

from core.errors import InvalidRecording, InvalidTrajectory, InvalidTraverse
from core.places import Pose
from core.recordings import Poses, open_recording
from core.recordings.paths import check_lost_poses
from core.recordings.pose_names import named_pose
from tests.service.scenes import jpeg

NEAR = "@0548164.30@4180910.43@10@S@037.77474@-122.45305@pano@3@{}@1.5@0@52.3@20180312@@.jpg"


def folder(path: Path, *names: str) -> Path:
    """A folder of pictures of these names."""
    path.mkdir()
    for index, name in enumerate(names):
        (path / name).write_bytes(jpeg(index, 64, 48))
    return path


@pytest.mark.parametrize(
    ("name", "pose", "zone"),
    [
        (NEAR.format("90"), Pose(x=548164.30, y=4180910.43, heading=0), "10N"),
        (NEAR.format("0"), Pose(x=548164.30, y=4180910.43, heading=90), "10N"),
        (NEAR.format("300.25"), Pose(x=548164.30, y=4180910.43, heading=149.75), "10N"),
        (NEAR.format(""), Pose(x=548164.30, y=4180910.43), "10N"),
        ("@548164.30@4180910.43@09@C@@@@@@@@@@@.png", Pose(x=548164.3, y=4180910.43), "9S"),
        ("@548164.30@4180910.43@.jpg", Pose(x=548164.3, y=4180910.43), ""),
        ("@@@10@S@37.77474@-122.45305@@@90@@@@@@.jpg", Pose(latitude=37.77474, longitude=-122.45305, heading=90), ""),
        ("@@@@@@@@@@@@@@@.jpg", None, ""),
    ],
)
def test_a_name_says_where_its_picture_was_taken(name: str, pose: Pose | None, zone: str) -> None:
    found = named_pose(name)
    assert found is not None and (found.pose, found.zone) == (pose, zone)


@pytest.mark.parametrize("name", ["a.jpg", "@.jpg", "@1@.jpg", "x@1@2@.jpg"])
def test_other_names_say_nothing(name: str) -> None:
    assert named_pose(name) is None


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("@a@2@.jpg", "east 'a' is not a number"),
        ("@1_0@2@.jpg", "east '1_0' is not a number"),
        ("@1@nan@.jpg", "north 'nan' is not a number"),
        ("@1e10@2@.jpg", "x: "),
        ("@@@10@S@91@2@@@@@@@@.jpg", "latitude: "),
        (NEAR.format("361"), "heading 361 is not within -360 to 360"),
        (NEAR.format("north"), "heading 'north' is not a number"),
    ],
)
def test_a_name_whose_pose_cannot_be_says_why(name: str, fault: str) -> None:
    found = named_pose(name)
    assert found is not None and found.pose is None and found.fault.startswith(fault)


@pytest.mark.parametrize(
    ("count", "others", "lost", "told"),
    [
        (
            7,
            [NEAR.format("390")],
            1,
            f"1 of 8 file names say no pose that can be: {NEAR.format('390')} (heading 390 is ",
        ),
        (7, ["roof.jpg"], 1, "1 of 8 file names say no pose that can be: roof.jpg (another form)."),
        (8, [NEAR.format("390"), "@a@2@.jpg", "s.jpg", "t.jpg"], 4, "s.jpg (another form), …"),
        (15, ["roof.jpg"], 1, "roof.jpg (another form)"),
    ],
)
def test_a_few_bad_names_cost_the_other_poses_nothing(
    count: int, others: list[str], lost: int, told: str, tmp_path: Path
) -> None:
    good = [f"@54816{number}.30@4180910.43@10@S@.jpg" for number in range(count)]
    with open_recording(folder(tmp_path / "street", *good, *others)) as recording:
        assert {frame.name for frame in recording.frames if frame.pose is not None} == set(good)
        assert recording.lost == lost and sum(told in one for one in recording.remarks) == 1, recording.remarks
        if 10 * lost > count + len(others):
            with pytest.raises(InvalidTrajectory, match=r"lose their pose.*file names say no pose.*--allow-lost-poses"):
                check_lost_poses(recording)
        else:
            check_lost_poses(recording)


def test_names_that_all_say_what_cannot_be_are_remarked(tmp_path: Path) -> None:
    with open_recording(folder(tmp_path / "street", NEAR.format("390"), NEAR.format("400"))) as recording:
        (told,) = recording.remarks
    assert "heading 390" in told and told.endswith("Poses are those of EXIF data.") and recording.lost == 0


def test_ordinary_names_of_which_one_has_the_form_say_nothing(tmp_path: Path) -> None:
    with open_recording(folder(tmp_path / "plain", "@anna@home@.jpg", "b.jpg", "c.jpg")) as recording:
        assert recording.remarks == [] and recording.lost == 0


def test_a_trajectory_gives_poses_whatever_names_say(tmp_path: Path) -> None:
    street = folder(tmp_path / "street", "@1@1@.jpg", "@2@1@.jpg", "roof.jpg")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    with open_recording(street, poses=Poses(file=tmp_path / "poses.txt")) as recording:
        assert all(frame.pose is not None for frame in recording.frames) and recording.lost == 0


def test_northings_keep_their_centimetres(tmp_path: Path) -> None:
    names = [f"@0548164.{cent:02}@4180910.{cent:02}@10@S@@@@@@@@@@@.jpg" for cent in (0, 1, 99)]
    with open_recording(folder(tmp_path / "street", *names)) as recording:
        found = [frame.pose for frame in recording.frames]
    assert [(pose.x, pose.y) for pose in found if pose] == [
        (548164.0, 4180910.0), (548164.01, 4180910.01), (548164.99, 4180910.99),
    ]  # fmt: skip


def test_a_folder_brings_the_poses_in_its_names_and_says_so(tmp_path: Path) -> None:
    street = folder(tmp_path / "street", NEAR.format("90"), NEAR.format("180"), "@@@@@@@@@@@@@@x@.jpg")
    with open_recording(street) as recording:
        assert {frame.name: frame.described().pose for frame in recording.frames} == {
            NEAR.format("90"): Pose(x=548164.30, y=4180910.43, heading=0),
            NEAR.format("180"): Pose(x=548164.30, y=4180910.43, heading=270),
            "@@@@@@@@@@@@@@x@.jpg": None,
        }
        (remark,) = recording.remarks
    assert "UTM zone 10N" in remark and "2 of 3 frames have one, 2 with a heading" in remark


def test_a_list_comes_before_names_unless_names_are_wanted(tmp_path: Path) -> None:
    name = NEAR.format("90")
    street = folder(tmp_path / "street", name)
    (street / "places.csv").write_text(f"file,x,y\n{name},1,2\n")
    with open_recording(street) as recording:
        assert recording.frames[0].pose == Pose(x=1, y=2)
    with open_recording(street, poses=Poses(names=True)) as recording:
        assert recording.frames[0].pose == Pose(x=548164.30, y=4180910.43, heading=0)


def test_names_of_which_some_say_nothing_are_used_where_they_are_wanted(tmp_path: Path) -> None:
    street = folder(tmp_path / "street", NEAR.format("90"), "roof.jpg")
    with open_recording(street) as recording:
        assert [frame.described().pose for frame in recording.frames] == [None, None]
        assert "--poses names" in recording.remarks[0]
    with open_recording(street, poses=Poses(names=True)) as recording:
        assert [frame.pose is None for frame in recording.frames] == [False, True]
        assert "1 of 2 frames have one" in recording.remarks[0] and recording.lost == 0


def test_zones_are_not_mixed_and_other_recordings_have_no_names(tmp_path: Path) -> None:
    names = "@0548164.30@4180910.43@10@S@.jpg", "@0248164.30@4180910.43@11@S@.jpg"
    with pytest.raises(InvalidTraverse, match=r"several zones of UTM \(10N, 11N\)"):
        open_recording(folder(tmp_path / "street", *names))
    with pytest.raises(InvalidTraverse, match="No file name of"):
        open_recording(folder(tmp_path / "plain", "a.jpg"), poses=Poses(names=True))
    with pytest.raises(InvalidRecording, match="is not a folder of pictures"):
        open_recording(tmp_path / "plain" / "a.mp4", poses=Poses(names=True))
