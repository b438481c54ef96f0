"""Geometric verification on pictures whose geometry is known, and on matches that determine nothing."""

from __future__ import annotations

from math import comb, log

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.frames.preprocessing import Pixels, second_look
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.geometry.verification import Verification, evidence, fitting, verify
from core.networks.xfeat import XFeat, load_xfeat
from core.threads import use_threads
from service.commands.timing.samples import sample_frame

Points = NDArray[np.float64]


@pytest.fixture(scope="module")
def network() -> XFeat:
    return load_xfeat()


def turned(degrees: float, scale: float = 1.0, aside: float = 0.0) -> Points:
    """A turn about the middle of a frame of 640 x 480, and a step aside, as a homography, float64 [3, 3]."""
    made = np.vstack([cv2.getRotationMatrix2D((320, 240), degrees, scale), [0, 0, 1]])
    made[0, 2] += aside
    return made


def tilted(share: float) -> Points:
    """What a turn of the camera to one side does: one edge grows, the other shrinks; float64 [3, 3]."""
    corners = np.array([(0, 0), (640, 0), (640, 480), (0, 480)], np.float32)
    moved = corners + np.array([(0, -share), (0, share), (0, -share), (0, share)], np.float32) * 480
    return np.asarray(cv2.getPerspectiveTransform(corners, moved.astype(np.float32)), np.float64)


CHANGES = {
    "shift": (turned(0, aside=60), 0.5),
    "turn": (turned(10), 0.4),
    "turn and shift": (turned(-8, 0.9, 40), 0.35),
    "nearer": (turned(0, 1.3), 0.3),
    "to one side": (tilted(0.08), 0.4),
}


def seen(network: XFeat, frame: Pixels, change: Points | None = None) -> Keypoints:
    if change is not None:
        frame = np.asarray(cv2.warpPerspective(frame, change, (640, 480)), np.uint8)
    return find_keypoints(network, frame)


def compared(a: Keypoints, b: Keypoints) -> Verification:
    return verify(a, [b])[0]


@pytest.mark.parametrize(("change", "least"), CHANGES.values(), ids=CHANGES)
def test_inliers_lie_where_a_known_change_has_put_them(network: XFeat, change: Points, least: float) -> None:
    frame = sample_frame(3)
    before, after = seen(network, frame), seen(network, frame, change)
    found = compared(before, after)
    ours, theirs = before.pixels()[found.matches[:, 0]], after.pixels()[found.matches[:, 1]]
    wanted = cv2.perspectiveTransform(ours[None], change)[0]
    missed = np.linalg.norm(wanted - theirs, axis=1)[found.inliers]
    assert found.inlier_count > least * len(found.matches) and found.evidence > 60
    # A flat scene leaves the epipolar lines free, so that some wrong matches fit by chance.
    # A pixel of the network is two wide here.
    assert np.median(missed) < 3 and (missed < 6).mean() > 0.7
    assert found.spread > 0.25


def test_another_scene_has_no_evidence(network: XFeat) -> None:
    query = seen(network, sample_frame(3))
    right, *others = verify(query, [seen(network, second_look(sample_frame(3))), *_scenes(network)])
    assert right.evidence > 100
    assert max(other.evidence for other in others) < 15
    assert right.keypoints[0] == len(query)


def _scenes(network: XFeat) -> list[Keypoints]:
    return [seen(network, sample_frame(seed)) for seed in (10, 11, 12, 13)]


@pytest.mark.parametrize("seed", [4, 5, 10, 17])
def test_a_frame_matches_itself_wholly(network: XFeat, seed: int) -> None:
    """All fundamental matrices fit equally; of the last three frames OpenCV's estimator finds none alone."""
    keypoints = seen(network, sample_frame(seed))
    found = compared(keypoints, keypoints)
    assert np.array_equal(found.matches[:, 0], found.matches[:, 1])
    assert found.inlier_count == len(found.matches) > 0.95 * len(keypoints)


def test_a_small_frame_is_recognized_too(network: XFeat) -> None:
    small = np.asarray(cv2.resize(sample_frame(5), (160, 120), interpolation=cv2.INTER_AREA), np.uint8)
    aside = np.asarray(cv2.resize(second_look(sample_frame(5)), (160, 120), interpolation=cv2.INTER_AREA), np.uint8)
    found = compared(seen(network, small), seen(network, aside))
    assert found.evidence > 20


def test_nothing_is_said_of_a_blank_frame(network: XFeat) -> None:
    blank, frame = seen(network, np.full((120, 160, 3), 90, np.uint8)), seen(network, sample_frame(6))
    for found in (compared(blank, frame), compared(frame, blank), compared(blank, blank)):
        assert (len(found.matches), found.inlier_count, found.evidence, found.spread) == (0, 0, 0, 0)
    assert verify(frame, []) == []


def test_threads_and_repetitions_change_nothing(network: XFeat) -> None:
    query, candidates = seen(network, sample_frame(3)), [seen(network, second_look(sample_frame(3))), *_scenes(network)]
    once = verify(query, candidates)
    try:
        use_threads(2)
        again = verify(query, candidates)
    finally:
        use_threads(1)
    for one, other in zip(once, again, strict=True):
        assert np.array_equal(one.matches, other.matches) and np.array_equal(one.inliers, other.inliers)
        assert one.evidence == other.evidence


SQUARE = np.array([(x * 40.0 + 7 * (y % 3), y * 40.0 + 5 * (x % 2)) for x in range(5) for y in range(5)])
DEGENERATE: dict[str, tuple[Points, Points]] = {
    "no match": (np.zeros((0, 2)), np.zeros((0, 2))),
    "one match": (SQUARE[:1], SQUARE[:1]),
    "seven matches": (SQUARE[:7], SQUARE[:7] + 3),
    "all at one point": (np.full((30, 2), 50.0), np.full((30, 2), 60.0)),
    "all on a line": (np.stack([np.arange(30.0), np.zeros(30)], 1), np.stack([np.arange(30.0), np.ones(30)], 1)),
    "all to one point": (SQUARE, np.full((25, 2), 60.0)),
}


@pytest.mark.parametrize(("ours", "theirs"), DEGENERATE.values(), ids=DEGENERATE)
def test_degenerate_matches_end_in_an_answer(ours: Points, theirs: Points) -> None:
    inliers = fitting(ours, theirs)
    assert inliers.shape == (len(ours),) and inliers.dtype == np.bool_
    if len(ours) < 8:
        assert not inliers.any()


@pytest.mark.parametrize("matches", [30, 100])
@pytest.mark.parametrize("swapped", [False, True])
def test_points_of_one_line_say_nothing_of_unrelated_pictures(matches: int, swapped: bool) -> None:
    """As a row of lamps at night: every point of the line fits every point of the other picture."""
    random = np.random.default_rng(4)
    for _ in range(5):
        anywhere = random.uniform((0, 0), (640, 480), (matches, 2))
        lamps = np.stack([random.uniform(0, 640, matches), 200 + random.normal(0, 1, matches)], axis=1)
        ours, theirs = (lamps, anywhere) if swapped else (anywhere, lamps)
        assert evidence(matches, int(fitting(ours, theirs).sum()), 0.008) < 10


def test_evidence_is_that_of_the_formula() -> None:
    expected = -log(3 * (40 - 7) * comb(40, 20) * comb(20, 7) * 0.01**13)
    assert evidence(40, 20, 0.01) == pytest.approx(expected)
    assert evidence(40, 7, 0.01) == evidence(100, 9, 0.05) == 0.0


def test_evidence_grows_with_inliers_and_falls_with_matches() -> None:
    by_inliers = [evidence(100, inliers, 0.01) for inliers in range(20, 101, 10)]
    by_matches = [evidence(matches, 40, 0.01) for matches in range(40, 400, 40)]
    assert by_inliers == sorted(by_inliers) and by_matches == sorted(by_matches, reverse=True)
