"""Videos: frames, their times, and which way up they are."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from core.errors import InvalidRecording, InvalidTrajectory
from core.frames.images import decode
from core.frames.preprocessing import Pixels
from core.recordings import Poses, open_recording
from tests.service.scenes import scene

FORMS = {"walk.avi": "MJPG", "walk.mp4": "mp4v", "walk.mkv": "mp4v"}


def write_video(path: Path, frames: int = 12, rate: float = 4.0, pictures: int = 4) -> list[Pixels]:
    """A video of some scenes, each shown for some frames; what was shown."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*FORMS[path.name]), rate, (64, 48))
    assert writer.isOpened()
    shown = [scene(index * pictures // frames, 64, 48) for index in range(frames)]
    for pixels in shown:
        writer.write(pixels)
    writer.release()
    return shown


def likest(pixels: Pixels, shown: list[Pixels]) -> int:
    """Which of the pictures is most like these pixels."""
    return int(np.argmin([np.abs(pixels.astype(int) - one).mean() for one in shown]))


@pytest.mark.parametrize("name", sorted(FORMS))
def test_frames_come_in_order_with_the_times_of_the_container(name: str, tmp_path: Path) -> None:
    shown = write_video(tmp_path / name)
    with open_recording(tmp_path / name) as recording:
        assert recording.name == "walk" and recording.remarks == []
        assert [frame.id for frame in recording.frames] == [f"walk-{index:06d}" for index in range(12)]
        assert [frame.nanoseconds for frame in recording.frames] == [index * 250_000_000 for index in range(12)]
        assert all(frame.timestamp is None for frame in recording.frames)
        scenes = shown[::3]
        for index in (0, 0, 5, 11, 2, 3):  # forward, again, and back
            assert likest(decode(recording.frames[index].load()), scenes) == index // 3
        assert recording.frames[7].load() == recording.frames[7].load()


def test_a_long_name_leaves_room_for_the_numbers_of_the_frames(tmp_path: Path) -> None:
    write_video(tmp_path / "walk.avi", frames=3)
    path = (tmp_path / "walk.avi").rename(tmp_path / f"{'a' * 200}.avi")
    with open_recording(path) as recording:
        ids = [frame.id for frame in recording.frames]
    assert len(set(ids)) == 3 and max(map(len, ids)) <= 128 and ids[2].endswith("a-000002")


def test_a_rotated_video_is_turned_upright(tmp_path: Path) -> None:
    path = tmp_path / "walk.mp4"
    shown = write_video(path, frames=3, pictures=1)
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40  # of a track's header of version 0 (ISO/IEC 14496-12, 8.3.2)
    assert struct.unpack_from(">9i", data, matrix) == (65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", data, matrix, 0, 65536, 0, -65536, 0, 0, 48 << 16, 0, 1 << 30)  # a quarter clockwise
    path.write_bytes(data)
    with open_recording(path) as recording:
        pixels = decode(recording.frames[1].load())
    assert pixels.shape == (64, 48, 3)
    turned = np.asarray(cv2.rotate(shown[1], cv2.ROTATE_90_CLOCKWISE), np.uint8)
    assert likest(pixels, [turned, np.ascontiguousarray(turned[::-1, ::-1])]) == 0


def test_a_video_that_is_cut_short_gives_what_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "walk.avi"
    write_video(path, frames=40)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with open_recording(path) as recording:
        assert 10 <= len(recording.frames) <= 25
        assert decode(recording.frames[-1].load()).shape == (48, 64, 3)


@pytest.mark.parametrize("name", ["empty.mp4", "text.avi", "missing.mkv"])
def test_what_is_no_video_is_refused(name: str, tmp_path: Path) -> None:
    if not name.startswith("missing"):
        (tmp_path / name).write_text("" if name.startswith("empty") else "no video " * 1000)
    with pytest.raises(InvalidRecording, match=name):
        open_recording(tmp_path / name)


def test_times_of_a_trajectory_count_from_the_beginning_of_a_video(tmp_path: Path) -> None:
    path = tmp_path / "walk.avi"
    write_video(path)
    (tmp_path / "walk.tum").write_text("".join(f"{second} {second} 0 0 0 0 0 1\n" for second in range(3)))
    with open_recording(path, poses=Poses(file=tmp_path / "walk.tum")) as recording:
        poses = [frame.pose for frame in recording.frames]
        assert [pose.x for pose in poses if pose is not None] == [index / 4 for index in range(9)]
        assert "3 of 12 frames get no pose" in recording.remarks[-1]
    (tmp_path / "walk.tum").write_text("1700000000 0 0 0 0 0 0 1\n1700000001 0 0 0 0 0 0 1\n")
    with pytest.raises(InvalidTrajectory, match=r"No frame of walk gets a pose: its frames are of 0.000 s to 2.750 s"):
        open_recording(path, poses=Poses(file=tmp_path / "walk.tum"))
