"""What pictures of a map say of its poses: rendered halls, in which all poses are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.geometry.pose import CAMERA, Hall, rotation
from core.frames.preprocessing import Pixels
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.maps import MapSettings
from core.method.encoder import Encoder, Encoding
from core.networks.xfeat import load_xfeat
from core.places import PlaceFields, Pose, Whereabouts
from core.recognition.pose_survey import SATELLITES, place_errors, pose_survey, turned_note
from core.recognition.recognition import describe
from core.store import Directory, Map
from tests.service.scenes import scene

Array = NDArray[np.float64]
Frame = tuple[Pixels, Encoding, Keypoints]
PLACES = 11


def walk(aside: float) -> tuple[list[Pixels], Array]:
    """Frames every 2 m along a hall, and their poses, of a camera that looks so many degrees to the left of the way."""
    random = np.random.default_rng(7)
    sides = [np.hstack([scene(20 * side + n) for n in range(6 if 1 < side < 4 else 1)]) for side in range(6)]
    hall, pictures, poses = Hall(40, 9, 5, sides), list[Pixels](), []
    for x in 4 + 2.0 * np.arange(PLACES):
        pose = np.array([x, random.normal(0, 0.1), aside + random.normal(0, 1)])
        pictures.append(hall.seen(np.array([*pose[:2], 2.5]), rotation(float(pose[2]))))
        poses.append(pose)
    return pictures, np.array(poses)


def views(encoder: Encoder, aside: float) -> tuple[list[Frame], Array]:
    """The frames of such a walk as they are enrolled."""
    network, (pictures, poses) = load_xfeat(), walk(aside)
    return [(one, encoder.encode(one), find_keypoints(network, one)) for one in pictures], poses


@pytest.fixture(scope="module")
def ahead(encoder: Encoder) -> tuple[list[Frame], Array]:
    return views(encoder, 0.0)


def mapped(folder: Path, encoder: Encoder, frames: list[Frame], poses: Array) -> Map:
    map_ = Directory(folder).create("hall", encoder.identity, encoder.dimension, MapSettings(), encoder.local_shape)
    map_.cameras.put("front", None, CAMERA)
    enrolled = []
    for number, ((picture, encoding, keypoints), (x, y, heading)) in enumerate(zip(frames, poses, strict=True)):
        fields = PlaceFields(pose=Pose(x=x, y=y, heading=heading % 360), camera="front", sequence="a")
        digest = number.to_bytes(32, "big")
        enrolled.append(describe(map_, f"p{number}", fields, None, digest, picture, encoding, keypoints=keypoints))
    map_.enrol(enrolled)
    return map_


def test_exact_poses_are_found_exact_and_headings_that_are_turned_are_named(
    tmp_path: Path, encoder: Encoder, ahead: tuple[list[Frame], Array]
) -> None:
    frames, poses = ahead
    map_ = mapped(tmp_path, encoder, frames, poses)
    (one,) = pose_survey(map_).traverses.values()
    assert one.turned == 0 and one.remark is None and one.pairs >= 8
    assert (one.metres or 0) < 0.25 and one.degrees is not None and one.degrees < 1.5
    where = map_.snapshot().whereabouts
    assert turned_note(map_, int(where.sequence[0])) is None
    for number, (x, y, heading) in enumerate(poses):  # somebody corrects them for the worse
        map_.patch(f"p{number}", {"pose": {"x": x, "y": y, "heading": (heading + 90) % 360}})
    (one,) = pose_survey(map_).traverses.values()
    assert one.turned == pytest.approx(-90, abs=6)
    assert one.remark is not None and "'a' are turned by" in one.remark and "Camera axes?" in one.remark
    errors = place_errors(map_, range(PLACES), map_.snapshot().whereabouts, surveyed=True)
    assert np.degrees(errors.turned) == pytest.approx(np.full(PLACES, one.turned))


def test_a_camera_that_looks_aside_and_says_so_is_right(tmp_path: Path, encoder: Encoder) -> None:
    (one,) = pose_survey(mapped(tmp_path, encoder, *views(encoder, 60.0))).traverses.values()
    assert one.turned == 0 and one.pairs >= 5


def test_errors_of_positions_show_and_what_is_stated_goes_before(
    tmp_path: Path, encoder: Encoder, ahead: tuple[list[Frame], Array]
) -> None:
    frames, poses = ahead
    noise = np.random.default_rng(3).normal(0, 0.5, (PLACES, 2))
    map_ = mapped(tmp_path, encoder, frames, poses + np.pad(noise, ((0, 0), (0, 1))))
    (one,) = pose_survey(map_).traverses.values()
    assert one.metres is not None and 0.2 < one.metres < 1.2
    where = map_.snapshot().whereabouts
    assert place_errors(map_, range(PLACES), where, surveyed=True).metres == pytest.approx(np.full(PLACES, one.metres))
    assert np.isnan(place_errors(map_, range(PLACES), where, surveyed=False).metres).all()
    map_.patch("p0", {"pose_accuracy": {"metres": 2.0, "degrees": 5.0}})
    stated = place_errors(map_, range(PLACES), map_.snapshot().whereabouts, surveyed=True)
    assert stated.metres[0] == 2 and stated.radians[0] == pytest.approx(np.radians(5))
    assert stated.metres[1] == pytest.approx(one.metres)


def test_satellites_are_off_by_what_no_picture_shows(tmp_path: Path, encoder: Encoder) -> None:
    map_ = mapped(tmp_path, encoder, [], np.empty((0, 3)))
    where = Whereabouts(np.array([1, 2], np.int8), np.zeros((2, 3)), np.zeros(2, np.int32), np.arange(2))
    assert place_errors(map_, [0, 1], where, surveyed=False).metres == pytest.approx([np.nan, SATELLITES], nan_ok=True)
