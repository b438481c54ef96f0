"""``placerec maps export --format mcap|colmap``: what other tools read of a map, and what placerec reads back."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from core.recordings import Poses, open_recording
from tests.service.commands.conftest import Placerec
from tests.service.scenes import jpeg
from tests.service.server import Server

INTRINSICS = {"fx": 300.0, "fy": 310.0, "cx": 150.0, "cy": 120.0}
DISTORTION = [0.1, -0.05, 0.001, 0.002, 0.01]


@pytest.fixture
def url(server: Server) -> list[str]:
    return ["--url", str(server.client.base_url)]


def turned(data: bytes) -> bytes:
    """The same picture, stored on its side, with the note that it has to be turned."""
    with Image.open(io.BytesIO(data)) as image:
        exif = Image.Exif()
        exif[0x0112] = 6
        file = io.BytesIO()
        image.transpose(Image.Transpose.ROTATE_90).save(file, "JPEG", exif=exif, quality=95)
    return file.getvalue()


def size_of(data: bytes) -> tuple[int, int]:
    with Image.open(io.BytesIO(data)) as image:
        return image.size


@pytest.fixture(scope="module")
def lab(server: Server) -> str:
    """A map in metres: a traverse of a calibrated camera, a place without a heading, one without a pose, a look."""
    server.create_map("for-others", keep="image")
    width, height = size_of(jpeg(0))
    lens = {"width": width, "height": height, **INTRINSICS, "distortion_model": "plumb_bob", "distortion": DISTORTION}
    made = server.client.put("/v1/maps/for-others/cameras/front", json={"mask": None, "intrinsics": lens})
    assert made.status_code == 201, made.text
    for number in range(3):
        fields = {"x": 2.0 * number, "y": 1.0, "heading": 30.0 * number, "camera": "front", "sequence": "früh am 1."}
        moment = f"2026-11-20T10:00:0{number}Z"
        done = server.enrol("for-others", f"p{number}", jpeg(number), timestamp=moment, **fields)
        assert done.status_code == 201, done.text
    server.enrol("for-others", "blind", jpeg(3), x=9, y=9)
    server.enrol("for-others", "nowhere", turned(jpeg(4)))
    look = server.client.post(
        "/v1/maps/for-others/places/p1/looks", content=jpeg(5), headers={"Content-Type": "image/jpeg"}
    )
    assert look.status_code == 201
    return "for-others"


def lines(path: Path) -> list[list[str]]:
    """The lines of a file of COLMAP that are neither empty nor remarks, by words."""
    return [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]


@pytest.mark.thorough
def test_a_folder_of_colmap(placerec: Placerec, url: list[str], lab: str, tmp_path: Path) -> None:
    folder = tmp_path / "model"
    said = placerec("maps", "export", lab, folder, "--format", "colmap", *url).stderr
    assert "5 frames, 3 with a pose and a heading; the focal length of camera is a guess." in " ".join(said.split())
    assert "1 places are left out: looks of other frames." in " ".join(said.split())
    images, model = folder / "images", folder / "sparse" / "0"
    assert sorted(path.name for path in images.iterdir()) == [
        *("blind.jpg", "nowhere.png", "p0.jpg", "p1.jpg", "p2.jpg", "places.csv")
    ]
    assert (images / "p1.jpg").read_bytes() == jpeg(1)
    assert lines(model / "points3D.txt") == []
    cameras = {words[0]: words[1:] for words in lines(model / "cameras.txt")}
    width, height = size_of(jpeg(0))
    front = ["FULL_OPENCV", str(width), str(height)]
    numbers = [300.0, 310.0, 150.5, 120.5, *DISTORTION, 0.0, 0.0, 0.0]
    poses = {words[9]: words for words in lines(model / "images.txt")}
    assert set(poses) == {"p0.jpg", "p1.jpg", "p2.jpg"} and len({words[0] for words in poses.values()}) == 3
    for words in poses.values():
        assert cameras[words[8]][:3] == front and list(map(float, cameras[words[8]][3:])) == numbers
    assert {words[0] for words in lines(folder / "intrinsics.txt")} == {*poses, "blind.jpg", "nowhere.png"}
    upright = cv2.imread(str(images / "nowhere.png"))
    assert upright is not None and upright.shape[:2] == (height, width)
    assert "SIMPLE_PINHOLE" in {words[0] for words in cameras.values()}
    assert not (folder / "origin.txt").exists()
    assert [path for path in tmp_path.iterdir() if path.name.startswith(".model")] == []


def seen_from(words: list[str], point: tuple[float, float, float]) -> NDArray[np.float64]:
    """A point of the world in the axes of an image's camera: right, down, ahead."""
    w, x, y, z, *shift = map(float, words[1:8])
    return Rotation.from_quat([x, y, z, w]).apply(point) + shift


@pytest.mark.thorough
def test_poses_of_colmap_are_those_of_the_cameras(placerec: Placerec, url: list[str], lab: str, tmp_path: Path) -> None:
    placerec("maps", "export", lab, tmp_path / "model", "--format", "colmap", *url)
    poses = {words[9]: words for words in lines(tmp_path / "model" / "sparse" / "0" / "images.txt")}
    # p0 stands at (0, 1) and looks along x; p2 at (4, 1), turned by 60° to the left.
    assert seen_from(poses["p0.jpg"], (5, 1, 0)) == pytest.approx([0, 0, 5], abs=1e-9)
    assert seen_from(poses["p0.jpg"], (5, 3, 0)) == pytest.approx([-2, 0, 5], abs=1e-9), "what is left of it"
    assert seen_from(poses["p0.jpg"], (5, 1, 2)) == pytest.approx([0, -2, 5], abs=1e-9), "what is above it"
    ahead = (4 + 2 * np.cos(np.pi / 3), 1 + 2 * np.sin(np.pi / 3), 0)
    assert seen_from(poses["p2.jpg"], ahead) == pytest.approx([0, 0, 2], abs=1e-9)


@pytest.mark.thorough
def test_the_folder_makes_the_map_again(
    placerec: Placerec, url: list[str], lab: str, tmp_path: Path, server: Server
) -> None:
    placerec("maps", "export", lab, tmp_path / "model", "--format", "colmap", *url)
    placerec("enrol", tmp_path / "model" / "images", "--map", "from-colmap", "--create", "--sequence", "s", *url)
    before, after = server.places(lab), server.places("from-colmap")
    assert before.keys() == after.keys()
    for name in before:
        assert (after[name]["pose"], after[name]["timestamp"]) == (before[name]["pose"], before[name]["timestamp"])


@pytest.mark.thorough
def test_an_mcap_file(placerec: Placerec, url: list[str], lab: str, tmp_path: Path) -> None:
    file = tmp_path / "lab.mcap"
    said = placerec("maps", "export", lab, file, "--format", "mcap", *url).stderr
    assert "5 frames, 4 with a pose." in " ".join(said.split())
    with file.open("rb") as opened:
        summary = make_reader(opened).get_summary()
    assert summary is not None and summary.statistics is not None
    counts = {summary.channels[one].topic: count for one, count in summary.statistics.channel_message_counts.items()}
    traverse = "/fr_h_am_1"
    assert counts == {
        f"{traverse}/front/image/compressed": 3,
        f"{traverse}/front/camera_info": 3,
        f"{traverse}/pose": 3,
        "/map/camera/image/compressed": 2,
        "/map/pose": 1,
    }
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    with open_recording(file, f"{traverse}/front/image/compressed", Poses(topic=f"{traverse}/pose")) as recording:
        assert recording.remarks == []
        for number, frame in enumerate(recording.frames):
            assert frame.load() == jpeg(number) and frame.timestamp is not None
            assert frame.timestamp.isoformat() == f"2026-11-20T10:00:0{number}+00:00"
            pose = frame.pose
            assert pose is not None and (pose.x, pose.y) == (2.0 * number, 1.0)
            assert pose.heading == pytest.approx(30.0 * number, abs=1e-9)
    assert "already exists" in placerec("maps", "export", lab, file, "--format", "mcap", *url, status=1).stderr


@pytest.mark.thorough
def test_the_messages_are_those_of_ros(placerec: Placerec, url: list[str], lab: str, tmp_path: Path) -> None:
    """As rosbags reads them from the definitions in the file."""
    from rosbags.highlevel import AnyReader

    file = tmp_path / "lab.mcap"
    placerec("maps", "export", lab, file, "--format", "mcap", *url)
    with AnyReader([file]) as reader:
        infos = [
            reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
            if connection.topic.endswith("camera_info")
        ]
    info: Any = infos[0]
    assert info.k.tolist() == [300, 0, 150, 0, 310, 120, 0, 0, 1] and info.d.tolist() == DISTORTION
    assert (info.distortion_model, info.header.frame_id) == ("plumb_bob", "front")


@pytest.mark.thorough
def test_a_map_in_degrees(placerec: Placerec, url: list[str], map_id: str, tmp_path: Path, server: Server) -> None:
    server.client.patch(f"/v1/maps/{map_id}", json={"keep": "image"})
    for number in range(2):
        pose = {"latitude": 48.0 + 1e-5 * number, "longitude": 2.0, "heading": 90.0}
        server.enrol(map_id, f"p{number}", jpeg(number), timestamp=f"2026-11-20T10:00:0{number}Z", **pose)
    placerec("maps", "export", map_id, tmp_path / "model", "--format", "colmap", *url)
    assert (tmp_path / "model" / "origin.txt").read_text() == "48.0 2.0\n"
    poses = {words[9]: words for words in lines(tmp_path / "model" / "sparse" / "0" / "images.txt")}
    north = np.radians(1e-5) * 6_371_008.8
    assert seen_from(poses["p1.jpg"], (3, north, 0)) == pytest.approx([0, 0, 3], abs=1e-6), "it looks to the east"
    placerec("maps", "export", map_id, tmp_path / "map.mcap", "--format", "mcap", *url)
    with open_recording(tmp_path / "map.mcap", poses=Poses(topic="/map/fix")) as recording:
        assert [frame.pose and frame.pose.latitude for frame in recording.frames] == [48.0, 48.00001]
    placerec("maps", "export", map_id, tmp_path / "model", "--format", "colmap", "--overwrite", *url)


@pytest.mark.thorough
@pytest.mark.parametrize("form", ["mcap", "colmap"])
def test_a_map_without_images_is_refused(
    placerec: Placerec, url: list[str], map_id: str, tmp_path: Path, server: Server, form: str
) -> None:
    server.enrol(map_id, "p", jpeg(1))
    target = tmp_path / "target"
    said = placerec("maps", "export", map_id, target, "--format", form, *url, status=1).stderr
    assert "keeps no images" in said and not target.exists()
    assert [path.name for path in tmp_path.iterdir() if "target" in path.name] == []
