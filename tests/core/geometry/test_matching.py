"""Matches of keypoints, all of them and at a glance."""

from __future__ import annotations

import numpy as np

from core.frames.preprocessing import second_look
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import LENGTH, RESOLUTION, Keypoints
from core.geometry.matching import GLANCED, count_matches, glance_at, mutual_matches
from core.networks.xfeat import packaged_xfeat
from service.commands.timing.samples import sample_frame


def test_matches_are_mutual_and_ties_go_to_the_lower_number() -> None:
    units = (np.eye(4, LENGTH) * RESOLUTION // 2).astype(np.float32)
    near = 1.6 * units  # the cosine of near[i] and near[i] is 0.64, of units[i] and 2 * units[i] 0.5
    query = np.stack([2 * units[0], 2 * units[0], 2 * units[1], near[2]])
    candidate = np.stack([2 * units[3], 2 * units[1], 2 * units[0], 2 * units[0], near[2]])
    assert mutual_matches(query, candidate).tolist() == [[0, 2], [2, 1]]


def test_nothing_matches_nothing() -> None:
    none, some = np.zeros((0, LENGTH), np.float32), np.ones((3, LENGTH), np.float32)
    for ours, theirs in ((none, some), (some, none), (none, none)):
        assert mutual_matches(ours, theirs).shape == (0, 2)


def test_a_glance_counts_the_matches_of_the_best_keypoints() -> None:
    query = find_keypoints(packaged_xfeat(), sample_frame(3))
    places = [find_keypoints(packaged_xfeat(), frame) for frame in (second_look(sample_frame(3)), sample_frame(8))]
    few = Keypoints(640, 480, places[0].positions[:5].copy(), places[0].descriptors[:5].copy())
    glances = np.stack([glance_at(one) for one in (*places, few)])
    wanted = [
        len(mutual_matches(*(one.descriptors[:GLANCED].astype(np.float32) for one in (query, place))))
        for place in (*places, few)
    ]
    assert count_matches(query, glances).tolist() == wanted
    assert wanted[0] > 1.5 * wanted[1] and wanted[2] <= 5
    assert count_matches(few, glances)[2] == 5, "each is its own"


def test_a_frame_without_keypoints_matches_nothing_at_a_glance() -> None:
    blank = Keypoints(640, 480, np.zeros((0, 2), np.uint16), np.zeros((0, LENGTH), np.int8))
    assert not glance_at(blank).any()
    assert count_matches(blank, np.zeros((2, GLANCED, LENGTH), np.int8)).tolist() == [0, 0]
    assert count_matches(blank, np.zeros((0, GLANCED, LENGTH), np.int8)).tolist() == []
