"""Turns and shifts between two cameras in scenes that are made of points, where all is known.

The covariance is judged by the normalized error squared, e^T P^-1 e: the sum over n draws of k values follows χ² with
n k degrees of freedom if P is right.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from core.errors import UnfitIntrinsics
from core.frames.intrinsics import Intrinsics
from core.geometry.keypoints import RESOLUTION, SHARES, Keypoints
from core.geometry.pose import RelativeView, relative_view, view_of_bearings
from core.geometry.verification import verify
from core.networks.xfeat import LENGTH

Array = NDArray[np.float64]
Kind = Literal["rough", "wall", "slanted wall", "curved wall"]
FOCAL = 400.0
"""Pixels, for a frame of 480 x 360."""
AHEAD = 8.0
"""Metres to the middle of each scene."""
BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Motion:
    """The query's camera against the place's: degrees to the left, down and to the right; metres ahead, left and up."""

    turn: tuple[float, float, float]
    shift: tuple[float, float, float]

    def rotation(self) -> Array:
        """From the query's axes (ahead, left, up) to the place's."""
        yaw, pitch, roll = np.radians(self.turn)
        steps = (np.array([roll, 0, 0]), np.array([0, pitch, 0]), np.array([0, 0, yaw]))
        about_x, about_y, about_z = (np.asarray(cv2.Rodrigues(step)[0], np.float64) for step in steps)
        return about_z @ about_y @ about_x


def points(kind: Kind, count: int, random: np.random.Generator) -> Array:
    """Points in front of the place's camera, in its optical frame, float64 [count, 3]."""
    x, y = random.uniform(-1, 1, (2, count)) * [[0.6], [0.45]]
    depth = {
        "rough": AHEAD * np.exp(random.normal(0, 0.6, count)),
        "wall": np.full(count, AHEAD),
        "slanted wall": AHEAD / (1 - 0.8 * x),
        "curved wall": AHEAD * (1 + 0.8 * x),
    }[kind]
    return np.column_stack([x * depth, y * depth, depth])


def seen(scene: Array, motion: Motion) -> Array:
    """The same points in the query's optical frame."""
    attitude = BODY.T @ motion.rotation() @ BODY
    return (scene - BODY.T @ np.array(motion.shift)) @ attitude


def noisy(scene: Array, random: np.random.Generator, pixels: float = 1.0) -> Array:
    """Directions of points as a camera sees them, each off by some pixels."""
    image = scene[:, :2] / scene[:, 2:] + random.normal(0, pixels / FOCAL, (len(scene), 2))
    rays = np.column_stack([image, np.ones(len(image))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def view(
    kind: Kind, motion: Motion, random: np.random.Generator, count: int = 150, wrong: float = 0.0
) -> RelativeView | None:
    scene = points(kind, count, random)
    there = seen(scene, motion)
    ahead = (there[:, 2] > 0.5) & (np.abs(there[:, :2] / there[:, 2:]) < [[0.9, 0.7]]).all(axis=1)
    place, query = noisy(scene[ahead], random), noisy(there[ahead], random)
    mixed = np.flatnonzero(random.random(len(query)) < wrong)
    query[mixed] = query[random.permutation(mixed)]
    return view_of_bearings(place, query, 1 / FOCAL)


def missed(motion: Motion, found: RelativeView) -> Array:
    """The rotation vector that would put the found turn right, float64 [3]."""
    return np.asarray(cv2.Rodrigues(motion.rotation() @ found.turn.T)[0][:, 0], np.float64)


MOTIONS = {
    "nothing": Motion((0, 0, 0), (0, 0, 0)),
    "a turn": Motion((20, 2, -1), (0, 0, 0)),
    "a wide turn": Motion((-30, 0, 0), (0, 0, 0)),
    "ahead": Motion((0, 0, 0), (1, 0, 0)),
    "aside": Motion((0, 0, 0), (0, -1, 0)),
    "ahead, aside and a turn": Motion((-10, 1, 1), (2, -1, 0.1)),
    "back, aside and a turn": Motion((-5, 0, 2), (-2, -2, 0)),
    "a little aside and a turn": Motion((15, 0, 0), (0.1, -0.2, 0)),
}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["rough", "wall", "slanted wall", "curved wall"])
@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_the_covariance_of_a_turn_covers_its_error(kind: Kind, motion: Motion) -> None:
    random, draws = np.random.default_rng(7), 6
    normalized = []
    for _ in range(draws):
        found = view(kind, motion, random)
        assert found is not None and found.source == "intrinsics"
        vector = missed(motion, found)
        normalized.append(float(vector @ np.linalg.solve(found.covariance[:3, :3], vector)))
        assert np.linalg.eigvalsh(found.covariance).min() > 0
    assert np.sum(normalized) < chi2.ppf(0.9999, 3 * draws)


@pytest.mark.thorough
def test_the_covariance_of_a_turn_is_no_larger_than_it_must_be() -> None:
    random, normalized = np.random.default_rng(8), []
    motion = MOTIONS["ahead, aside and a turn"]
    for _ in range(20):
        found = view("rough", motion, random)
        assert found is not None
        vector = missed(motion, found)
        normalized.append(float(vector @ np.linalg.solve(found.covariance[:3, :3], vector)))
        assert found.heading_offset == pytest.approx(-10, abs=0.5) and found.heading_spread < 0.2
    assert chi2.ppf(0.0001, 60) / 3 < np.sum(normalized) < chi2.ppf(0.9999, 60)


def test_the_shift_points_to_where_the_query_stands() -> None:
    random = np.random.default_rng(9)
    found = view("rough", Motion((-10, 0, 0), (2, -1, 0.2)), random)
    assert found is not None
    # Distances along rays are a little more than the depth of AHEAD metres.
    assert found.shift == pytest.approx(np.array([2, -1, 0.2]) / AHEAD, rel=0.25, abs=0.02)
    still = view("rough", Motion((20, 0, 0), (0, 0, 0)), random)
    assert still is not None and np.abs(still.shift).max() < 0.05


def test_a_wall_allows_two_answers_and_the_spread_says_so() -> None:
    """Both are as good, and 12 degrees apart."""
    random = np.random.default_rng(10)
    motion = Motion((-5, 0, 0), (-2, -2, 0))
    of_wall, of_scene = view("wall", motion, random), view("rough", motion, random)
    assert of_wall is not None and of_scene is not None
    assert of_wall.heading_spread > 3 and abs(of_wall.heading_offset + 5) < 3 * of_wall.heading_spread
    assert of_scene.heading_spread < 0.3 and of_scene.heading_offset == pytest.approx(-5, abs=1)


@pytest.mark.thorough
@pytest.mark.parametrize("wrong", [0.1, 0.3])
@pytest.mark.parametrize("motion", [MOTIONS["a turn"], MOTIONS["ahead, aside and a turn"]], ids=["turn", "shift"])
def test_wrong_matches_change_little(motion: Motion, wrong: float) -> None:
    random = np.random.default_rng(11)
    for _ in range(5):
        found = view("rough", motion, random, wrong=wrong)
        assert found is not None
        assert np.degrees(np.linalg.norm(missed(motion, found))) < 1.5


def test_fewer_matches_say_less_and_too_few_nothing() -> None:
    random, motion = np.random.default_rng(12), MOTIONS["ahead, aside and a turn"]
    few, many = view("rough", motion, random, 40), view("rough", motion, random, 300)
    assert few is not None and many is not None
    assert few.heading_spread > 1.5 * many.heading_spread
    assert view("rough", motion, random, 8) is None
    rays = noisy(points("rough", 100, random), random)
    assert view_of_bearings(np.full((50, 3), np.nan), rays[:50], 1 / FOCAL) is None


def test_one_point_over_and_over_breaks_nothing() -> None:
    same = np.tile([[0.0, 0.0, 1.0]], (40, 1))
    found = view_of_bearings(same, same, 1 / FOCAL)
    assert found is None or np.isfinite(found.covariance).all()


def pair(motion: Motion, camera: Intrinsics, random: np.random.Generator) -> tuple[Keypoints, Keypoints]:
    """Keypoints of a query and of a place whose cameras see one rough scene."""
    scene = points("rough", 300, random)
    there = seen(scene, motion)
    query, place = camera.project(there), camera.project(scene)
    size = np.array([camera.width, camera.height])
    both = (there[:, 2] > 0.5) & ((query > 1) & (query < size - 1) & (place > 1) & (place < size - 1)).all(axis=1)
    directions = random.normal(size=(int(both.sum()), LENGTH))
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    descriptors = np.clip(np.rint(directions / lengths * RESOLUTION), -127, 127).astype(np.int8)

    def found(pixels: Array) -> Keypoints:
        shares = (pixels[both] + random.normal(0, 0.5, (int(both.sum()), 2))) / size * SHARES
        return Keypoints(camera.width, camera.height, np.clip(shares, 0, SHARES - 1).astype(np.uint16), descriptors)

    return found(query), found(place)


LENSES = {
    "none": Intrinsics(width=640, height=480, fx=420, fy=420, cx=319.5, cy=239.5),
    "barrel": Intrinsics(
        width=640, height=480, fx=380, fy=382, cx=310, cy=250, distortion_model="plumb_bob",
        distortion=(-0.28, 0.07, 0.0002, 0.0, 0.0),
    ),
    "fisheye": Intrinsics(
        width=640, height=480, fx=300, fy=300, cx=319.5, cy=239.5, distortion_model="equidistant",
        distortion=(-0.01, 0.02, -0.02, 0.005),
    ),
}  # fmt: skip


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("degrees", [-25, 0, 12])
def test_a_turn_is_measured_through_any_lens(camera: Intrinsics, degrees: float) -> None:
    random = np.random.default_rng(13)
    query, place = pair(Motion((degrees, 0, 0), (0.8, 0.4, 0)), camera, random)
    found = relative_view(query, place, verify(query, [place])[0], camera, camera)
    assert found is not None and found.source == "intrinsics"
    assert abs(found.heading_offset - degrees) < max(0.3, 4 * found.heading_spread) and found.heading_spread < 1


@pytest.mark.thorough
@pytest.mark.parametrize("focal", [300, 420, 700])
@pytest.mark.parametrize("degrees", [-15, 0, 10])
def test_without_intrinsics_the_spread_covers_the_range_of_lenses(focal: float, degrees: float) -> None:
    random = np.random.default_rng(14)
    camera = Intrinsics(width=640, height=480, fx=focal, fy=focal, cx=319.5, cy=239.5)
    query, place = pair(Motion((degrees, 0, 0), (0, 0, 0)), camera, random)
    verified = verify(query, [place])[0]
    for one in (None, camera):  # one of the two is not known
        found = relative_view(query, place, verified, one, None)
        assert found is not None and found.source == "field-of-view"
        assert abs(found.heading_offset - degrees) < 2.5 * found.heading_spread + 0.3
    nothing_known = relative_view(query, place, verified)
    assert nothing_known is not None and (nothing_known.heading_spread > 1) == (degrees != 0)


@pytest.mark.parametrize("degrees", [-10, 0, 10])
def test_a_camera_that_stands_or_only_turns_is_not_said_to_have_moved(degrees: float) -> None:
    query, place = pair(Motion((degrees, 0, 0), (0, 0, 0)), LENSES["none"], np.random.default_rng(17))
    query = query if degrees else place  # the very same frame, which leaves the fundamental matrix open
    found = relative_view(query, place, verify(query, [place])[0], LENSES["none"], LENSES["none"])
    assert found is not None and found.heading_offset == pytest.approx(degrees, abs=0.3)
    assert 0.01 < found.heading_spread < 0.5
    spread = np.sqrt(np.diag(found.covariance)[3:])
    assert (np.abs(found.shift) < 4 * spread).all() and np.abs(found.shift).max() < 0.02 and spread.max() < 0.02


def test_intrinsics_are_scaled_to_the_frame_or_refused() -> None:
    camera = LENSES["barrel"]
    query, place = pair(Motion((10, 0, 0), (0.5, 0, 0)), camera, np.random.default_rng(15))
    verified = verify(query, [place])[0]
    twice = camera.of_size(1280, 960)
    found = relative_view(query, place, verified, twice, camera)
    assert found is not None and found.heading_offset == pytest.approx(10, abs=0.5)
    with pytest.raises(UnfitIntrinsics, match="640 x 480"):
        relative_view(query, place, verified, LENSES["none"].model_copy(update={"height": 360, "cy": 179.5}), camera)


def test_pictures_of_two_scenes_have_no_view() -> None:
    random = np.random.default_rng(16)
    query, _ = pair(MOTIONS["a turn"], LENSES["none"], random)
    _, place = pair(MOTIONS["a turn"], LENSES["none"], random)
    assert relative_view(query, place, verify(query, [place])[0], LENSES["none"], LENSES["none"]) is None
