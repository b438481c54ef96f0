"""MCAP files of Foxglove's messages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from core.errors import InvalidRecording, InvalidTrajectory, UnknownTopic
from core.places import Pose
from core.recordings import Poses, open_recording
from tests.core.recordings.bags import SECOND, START
from tests.core.recordings.foxglove import Form, Message, time, write
from tests.service.scenes import jpeg, scene

FORMS: tuple[Form, ...] = ("protobuf", "json")


def picture(number: int, received: int = 5) -> Message:
    """A picture of each second, stamped; it was received all at once."""
    fields = {"timestamp": time(START + number * SECOND), "frame_id": "camera", "data": jpeg(number), "format": "jpeg"}
    return "/camera", "CompressedImage", received, fields


def pose(number: int, **position: float) -> Message:
    quarter = {"x": 0.0, "y": 0.0, "z": 0.5**0.5, "w": 0.5**0.5}
    at = {"position": {"x": 2.0 * number, "y": 1.0, "z": 0.5, **position}, "orientation": quarter}
    fields = {"timestamp": time(START + number * SECOND), "frame_id": "map", "pose": at}
    return "/pose", "PoseInFrame", 7, fields


@pytest.mark.parametrize("form", FORMS)
def test_pictures_and_poses(form: Form, tmp_path: Path) -> None:
    path = write(tmp_path / "walk.mcap", form, [one(number) for number in range(4) for one in (picture, pose)])
    with open_recording(path, poses=Poses(topic="/pose")) as recording:
        assert recording.remarks == []
        assert [frame.id for frame in recording.frames] == [f"camera-{1_700_000_000 + n}.000000000" for n in range(4)]
        assert [frame.load() for frame in recording.frames] == [jpeg(number) for number in range(4)]
        found = [frame.pose for frame in recording.frames]
        assert [(at.x, at.y, at.z, at.heading) for at in found if at is not None] == [
            pytest.approx((2.0 * number, 1.0, 0.5, 90)) for number in range(4)
        ]


@pytest.mark.parametrize("form", FORMS)
def test_raw_pixels_and_satellites(form: Form, tmp_path: Path) -> None:
    pixels = scene(1)
    height, width = pixels.shape[:2]
    raw = {
        "timestamp": time(START),
        "frame_id": "camera",
        "width": width,
        "height": height,
        "encoding": "bgr8",
        "step": 3 * width,
        "data": pixels.tobytes(),
    }
    place = Pose(latitude=48.5, longitude=-2.5, z=30.0)
    fix = {"timestamp": time(START), "frame_id": "gps", "latitude": 48.5, "longitude": -2.5, "altitude": 30.0}
    path = write(tmp_path / "raw.mcap", form, [("/raw", "RawImage", 1, raw), ("/fix", "LocationFix", 1, fix)])
    with open_recording(path, poses=Poses(topic="/fix")) as recording:
        (frame,) = recording.frames
        read = cv2.imdecode(np.frombuffer(frame.load(), np.uint8), cv2.IMREAD_COLOR)
        assert read is not None and np.array_equal(read, pixels) and frame.pose == place


def transform(number: int, parent: str, child: str, **moved: float) -> dict[str, Any]:
    level = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    translation = {"x": 0.0, "y": 0.0, "z": 0.0, **moved}
    fields = {"timestamp": time(START + number * SECOND), "parent_frame_id": parent, "child_frame_id": child}
    return {**fields, "translation": translation, "rotation": level}


@pytest.mark.parametrize("form", FORMS)
def test_transforms(form: Form, tmp_path: Path) -> None:
    messages: list[Message] = [("/mount", "FrameTransform", 1, transform(0, "base", "camera", z=0.7))]
    for number in range(3):
        several = {"transforms": [transform(number, "odom", "base", x=1.0 * number)]}
        messages += [picture(number), ("/tf", "FrameTransforms", 1, several)]
    path = write(tmp_path / "tf.mcap", form, messages)
    with open_recording(path, poses=Poses(topic="/tf")) as recording:
        assert [frame.pose for frame in recording.frames] == [Pose(x=n, y=0, z=0.7, heading=0) for n in range(3)]


@pytest.mark.parametrize("form", FORMS)
def test_poses_that_are_none_are_counted(form: Form, tmp_path: Path) -> None:
    endless = float("inf") if form == "protobuf" else 1e400  # JSON's own writing of it
    path = write(tmp_path / "walk.mcap", form, [picture(0), pose(0), pose(1, x=endless)])
    with open_recording(path, poses=Poses(topic="/pose")) as recording:
        (told,) = recording.remarks
        assert told.startswith("1 of 2 messages of /pose have a number that is none") and "1700000001.000 s" in told


@pytest.mark.parametrize("damage", [b"", b"\xff\xff", "a name"])
def test_a_schema_that_defines_nothing_is_said(damage: Any, tmp_path: Path) -> None:
    data = b"" if damage == "a name" else damage
    path = write(tmp_path / "walk.mcap", "protobuf", [picture(0)], data)
    with open_recording(path) as recording:
        assert "1 of 1 messages of /camera have no stamp" in recording.remarks[0]
        with pytest.raises(InvalidRecording, match=r"schema of foxglove\.CompressedImage is damaged or incomplete"):
            recording.frames[0].load()


def test_messages_of_json_that_are_none(tmp_path: Path) -> None:
    fields: list[Any] = [[1, 2], {"timestamp": "soon", "data": 7}, {"timestamp": time(START), "data": "no base64!"}]
    path = write(tmp_path / "walk.mcap", "json", [("/camera", "CompressedImage", 9, one) for one in fields])
    with open_recording(path) as recording:
        assert len(recording.frames) == 3
        for frame in recording.frames:
            with pytest.raises(InvalidRecording, match="is damaged"):
                frame.load()
    poses: list[Any] = [{"timestamp": time(START), "pose": {"position": {"x": "far", "y": 0, "z": 0}}}]
    path = write(tmp_path / "poses.mcap", "json", [picture(0), *(("/pose", "PoseInFrame", 9, one) for one in poses)])
    with pytest.raises(InvalidRecording, match=r"no foxglove\.PoseInFrame"):
        open_recording(path, poses=Poses(topic="/pose"))


def test_a_coding_that_is_not_read_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "walk.mcap", "protobuf", [picture(0)])
    data = path.read_bytes().replace(b"\x08\x00\x00\x00protobuf\x00", b"\x08\x00\x00\x00flatbuff\x00")
    (tmp_path / "other.mcap").write_bytes(data)
    with pytest.raises((UnknownTopic, InvalidRecording)):
        open_recording(tmp_path / "other.mcap")


def test_frames_go_with_transforms_alone(tmp_path: Path) -> None:
    path = write(tmp_path / "walk.mcap", "json", [picture(0), pose(0)])
    with pytest.raises(InvalidTrajectory, match="has poses and no transforms"):
        open_recording(path, poses=Poses(topic="/pose", moving="base"))
    with pytest.raises(InvalidRecording, match="go with a --pose-topic of transforms"):
        open_recording(path, poses=Poses(fixed="map"))
