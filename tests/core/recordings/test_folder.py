"""Folders of pictures of every format that OpenCV reads."""

from __future__ import annotations

from pathlib import Path
from typing import Literal
from unicodedata import normalize

import cv2
import numpy as np
import pytest

from core.errors import EmptyImage, InvalidImage, InvalidRecording, InvalidTraverse, NotAnImage, UnsupportedFormat
from core.frames.images import decode
from core.frames.preprocessing import Pixels
from core.places import Pose, PoseAccuracy
from core.recordings import Poses, open_recording
from core.recordings.pictures import sendable
from tests.service.scenes import encoded, jpeg, scene

COLOURS = scene(1, 64, 48)
GREY = np.asarray(cv2.cvtColor(COLOURS, cv2.COLOR_BGR2GRAY), np.uint8)
DEEP = COLOURS.astype(np.uint16) * 256 + 99
LOSSLESS: dict[str, Pixels] = {
    **dict.fromkeys((".bmp", ".dib", ".tiff", ".tif", ".ppm", ".pnm", ".pam", ".ras", ".sr"), COLOURS),
    ".pgm": GREY,
    ".pbm": np.where(GREY > 127, 255, 0).astype(np.uint8),
}
OTHERS = (".jp2", ".avif", ".gif")
"""Formats that lose something when OpenCV writes them; what they hold afterwards is kept."""


@pytest.mark.parametrize("suffix", sorted(LOSSLESS))
def test_lossless_formats_keep_every_pixel(suffix: str) -> None:
    pixels = LOSSLESS[suffix]
    png = sendable(encoded(pixels, suffix))
    assert png.startswith(b"\x89PNG") and png == sendable(encoded(pixels, suffix))
    colours = pixels if pixels.ndim == 3 else cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    assert np.array_equal(decode(png), colours)


@pytest.mark.parametrize("suffix", OTHERS)
def test_other_formats_keep_what_they_hold(suffix: str) -> None:
    data = encoded(COLOURS, suffix)
    kept = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
    assert np.array_equal(decode(sendable(data)), kept)


@pytest.mark.parametrize("suffix", [".tiff", ".pnm", ".jp2"])
def test_sixteen_bits_stay_and_are_seen_as_eight(suffix: str) -> None:
    png = sendable(bytes(cv2.imencode(suffix, DEEP, [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, 1000])[1]))
    kept = np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED))
    assert kept.dtype == np.uint16 and np.array_equal(kept, DEEP)
    assert np.array_equal(decode(png), COLOURS)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_formats_of_the_service_stay_as_they_are(suffix: str) -> None:
    data = encoded(COLOURS, suffix)
    assert sendable(data) is data
    assert sendable(data[:60]) == data[:60]  # the service says what is wrong with it


@pytest.mark.parametrize(
    ("data", "error", "text"),
    [
        (b"", EmptyImage, "no bytes"),
        (b"not an image", NotAnImage, "no image format"),
        (encoded(COLOURS, ".bmp")[:20], NotAnImage, "damaged"),
        (bytes(cv2.imencode(".hdr", COLOURS.astype(np.float32) / 255)[1]), UnsupportedFormat, "float32"),
        (bytes(cv2.imencodemulti(".tiff", [COLOURS, COLOURS])[1]), UnsupportedFormat, "several pictures"),
    ],
)
def test_what_no_frame_can_be_made_of_is_refused(data: bytes, error: type[InvalidImage], text: str) -> None:
    with pytest.raises(error, match=text):
        sendable(data)


def test_a_folder_of_many_formats_is_one_recording(tmp_path: Path) -> None:
    for index, suffix in enumerate((".bmp", ".jpg", ".pgm", ".tif", ".webp")):
        (tmp_path / f"{index}{suffix}").write_bytes(encoded(GREY if suffix == ".pgm" else COLOURS, suffix))
    with open_recording(tmp_path, prefix="a-") as recording:
        assert [frame.id for frame in recording.frames] == ["a-0", "a-1", "a-2", "a-3", "a-4"]
        assert [frame.name for frame in recording.frames][2:4] == ["2.pgm", "3.tif"]
        assert [decode(frame.load()).shape for frame in recording.frames] == [(48, 64, 3)] * 5


def test_a_list_gives_order_ids_poses_and_times(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.jpg").write_bytes(jpeg(1, 64, 48))
    (tmp_path / "places.csv").write_text("file,id,x,y,timestamp\nb.jpg,door,1,2,2026-01-01T00:00:00.5Z\na.jpg,,,,\n")
    with open_recording(tmp_path) as recording:
        door, plain = recording.frames
        assert (door.id, plain.id) == ("door", "a")
        assert door.pose is not None and (door.pose.x, door.pose.y) == (1, 2) and plain.pose is None
        assert door.nanoseconds == 1_767_225_600_500_000_000
        assert "1 images of" in recording.remarks[0]


@pytest.mark.parametrize("key", ["level", "floor", "storey", "story"])
def test_a_list_gives_levels_and_how_exact_poses_are(tmp_path: Path, key: str) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.jpg").write_bytes(jpeg(1, 64, 48))
    rows = f"file,x,y,{key},accuracy_metres,accuracy_degrees\na.jpg,1,2,-1,0.5,2\nb.jpg,1,2,,,\n"
    (tmp_path / "places.csv").write_text(rows)
    with open_recording(tmp_path) as recording:
        cellar, plain = recording.frames
    assert (cellar.level, cellar.pose_accuracy) == ("-1", PoseAccuracy(metres=0.5, degrees=2.0))
    assert (plain.level, plain.pose_accuracy) == (None, None)
    for wrong, why in (
        (rows.replace(",-1,", ",a/b,"), "line 2: .*cannot name a level"),
        (rows.replace(",0.5,", ",0,"), "line 2: metres"),
        (rows.replace("0.5,2", ",2"), "line 2: metres"),
        (rows.replace("accuracy_metres", "level" if key != "level" else "floor"), "given twice"),
    ):
        (tmp_path / "places.csv").write_text(wrong)
        with pytest.raises(InvalidTraverse, match=why):
            open_recording(tmp_path)


Form = Literal["NFC", "NFD"]


@pytest.mark.parametrize(("listed", "on_disk"), [("NFC", "NFD"), ("NFD", "NFC"), ("NFD", "NFD")])
def test_names_of_files_have_one_form(tmp_path: Path, listed: Form, on_disk: Form) -> None:
    (tmp_path / normalize(on_disk, "Café 1.jpg")).write_bytes(jpeg(1, 64, 48))
    with open_recording(tmp_path) as recording:
        assert recording.frames[0].id == "Caf-1"
    (tmp_path / "places.csv").write_text(f"file,x,y\n{normalize(listed, 'Café 1.jpg')},1,2\n")
    with open_recording(tmp_path) as recording:
        assert (recording.frames[0].id, recording.frames[0].pose) == ("Caf-1", Pose(x=1, y=2))


@pytest.mark.parametrize(
    ("cell", "taken"), [("1.5", 1.5), ("+1.5", 1.5), ("-2e1", -20.0), ("1_0", None), ("inf", None)]
)
def test_numbers_of_a_list_are_plain(tmp_path: Path, cell: str, taken: float | None) -> None:
    (tmp_path / "a.jpg").write_bytes(jpeg(1, 64, 48))
    (tmp_path / "places.csv").write_text(f"file,x,y\na.jpg,{cell},2\n")
    if taken is None:
        with pytest.raises(InvalidTraverse, match="line 2"):
            open_recording(tmp_path)
        return
    with open_recording(tmp_path) as recording:
        assert recording.frames[0].pose == Pose(x=taken, y=2)


def test_options_of_bags_do_not_go_with_folders(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(jpeg(1, 64, 48))
    for topic, poses in (("/camera", Poses()), (None, Poses(topic="/odom"))):
        with pytest.raises(InvalidRecording, match="is not a bag, so it has no topics"):
            open_recording(tmp_path, topic, poses)
    with pytest.raises(InvalidTraverse, match="cannot be read as a directory"):
        open_recording(tmp_path / "missing")


def test_a_trajectory_of_kitti_places_the_pictures_of_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "image_0"
    folder.mkdir()
    for index in range(3):
        (folder / f"{index:06d}.png").write_bytes(encoded(scene(index, 64, 48), ".png"))
    ahead = [f"1 0 0 {-2 * index} 0 1 0 0 0 0 1 {3 * index}\n" for index in range(3)]
    (tmp_path / "poses.txt").write_text("".join(ahead))
    with open_recording(folder, poses=Poses(file=tmp_path / "poses.txt")) as recording:
        poses = [frame.pose for frame in recording.frames]
    assert [(pose.x, pose.y, pose.heading) for pose in poses if pose] == [(0, 0, 0), (3, 2, 0), (6, 4, 0)]
