"""Verification recognizes the view that it was shown: pictures, compared with themselves and with near copies."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.geometry.same_view import (
    SETS,
    TRAVERSES,
    VIEWS,
    ComparedPictures,
    compared,
    pictures,
    same_views,
    views_in_turn,
)
from core.geometry.detection import find_keypoints
from core.networks.xfeat import XFeat, load_xfeat
from lab.training.photographs import read
from tests.service.scenes import scene, stranger

DATASETS = Path(__file__).parents[3] / "shared/datasets"
PICTURES, EVERY = 200, 14
HERE = all(
    (DATASETS / part).is_dir()
    for part in (*(f"eval/{name}" for name in TRAVERSES), *(f"train/{name}" for name in SETS))
)


@pytest.fixture(scope="module")
def network() -> XFeat:
    return load_xfeat()


def failed(made: list[ComparedPictures]) -> list[ComparedPictures]:
    return [one for one in made if one.fails(one.inliers)]


@pytest.mark.thorough
def test_a_drawn_picture_is_recognized_in_every_view(network: XFeat) -> None:
    made = same_views(network, scene(37), "scene 37")
    assert [one.kind for one in made] == list(VIEWS)
    assert all(one.counts for one in made) and not failed(made)
    assert not any(2 * one.inliers < one.by_opencv for one in made)
    assert made[0].inliers == made[0].matches


def test_strangers_have_little_evidence(network: XFeat) -> None:
    shown = find_keypoints(network, scene(37))
    for seed in range(60, 66):
        one = compared("stranger", str(seed), find_keypoints(network, stranger(seed)), shown)
        assert max(one.evidence, one.evidence_by_opencv) < 40


@pytest.mark.thorough
@pytest.mark.skipif(not HERE, reason="the pictures of ../shared/datasets are not here")
def test_real_pictures_are_recognized(network: XFeat) -> None:
    """Each is compared with itself, and some with one other view, all of which have their turn."""
    made: list[ComparedPictures] = []
    for number, path in enumerate(pictures(DATASETS, PICTURES)):
        views = views_in_turn(number // EVERY, 1) if number % EVERY == 0 else ("the same",)
        made += same_views(network, read(path), path.relative_to(DATASETS).as_posix(), views)
    assert {one.kind for one in made} == set(VIEWS) and sum(one.counts for one in made) > 0.95 * len(made)
    assert not failed(made), "\n".join(map(str, failed(made)))
