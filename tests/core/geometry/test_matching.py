"""Matches of keypoints, all of them and at a glance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.frames.preprocessing import second_look
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import LENGTH, RESOLUTION, Keypoints
from core.geometry.matching import GLANCED, count_matches, glance_at, neighbors_among
from core.networks.xfeat import packaged_xfeat
from service.commands.timing.samples import sample_frame


def keypoints(descriptors: NDArray[np.generic]) -> Keypoints:
    return Keypoints(640, 480, np.zeros((len(descriptors), 2), np.uint16), descriptors.astype(np.int8))


def test_matches_are_mutual_and_ties_go_to_the_lower_number() -> None:
    units = np.repeat(np.eye(4, LENGTH // 4), 4, axis=1) * RESOLUTION / 2  # of the length RESOLUTION
    near = 0.8 * units[2]  # the cosine with itself counts as 0.64
    query = keypoints(np.stack([units[0], units[0], units[1], near]))
    candidate = keypoints(np.stack([units[3], units[1], units[0], units[0], near]))
    few = keypoints(units[1:2])
    assert neighbors_among(query, [candidate, few, few]).tolist() == [[2, -1, 1, -1], [-1, -1, 0, -1], [-1, -1, 0, -1]]


def test_nothing_matches_nothing() -> None:
    none, some = keypoints(np.zeros((0, LENGTH))), keypoints(np.full((3, LENGTH), 31))
    assert neighbors_among(none, [some, none]).shape == (2, 0)
    assert neighbors_among(some, [none]).tolist() == [[-1, -1, -1]]
    assert neighbors_among(some, [none, some]).tolist() == [[-1, -1, -1], [0, -1, -1]]
    assert neighbors_among(some, []).shape == (0, 3)


def test_a_glance_counts_the_matches_of_the_best_keypoints() -> None:
    query = find_keypoints(packaged_xfeat(), sample_frame(3))
    places = [find_keypoints(packaged_xfeat(), frame) for frame in (second_look(sample_frame(3)), sample_frame(8))]
    few = Keypoints(640, 480, places[0].positions[:5].copy(), places[0].descriptors[:5].copy())
    glances = np.stack([glance_at(one) for one in (*places, few)])
    best = [keypoints(one.descriptors[:GLANCED]) for one in (query, *places, few)]
    wanted = (neighbors_among(best[0], best[1:]) >= 0).sum(axis=1).tolist()
    assert count_matches(query, glances).tolist() == wanted
    assert wanted[0] > 1.5 * wanted[1] and wanted[2] <= 5
    assert count_matches(few, glances)[2] == 5, "each is its own"


def test_a_frame_without_keypoints_matches_nothing_at_a_glance() -> None:
    blank = Keypoints(640, 480, np.zeros((0, 2), np.uint16), np.zeros((0, LENGTH), np.int8))
    assert not glance_at(blank).any()
    assert count_matches(blank, np.zeros((2, GLANCED, LENGTH), np.int8)).tolist() == [0, 0]
    assert count_matches(blank, np.zeros((0, GLANCED, LENGTH), np.int8)).tolist() == []
