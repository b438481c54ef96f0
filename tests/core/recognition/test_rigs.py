"""Rigs: where the candidates of one camera are verified, so are those of the others."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import pytest

from core.frames.images import Pixels
from core.geometry.detection import find_keypoints
from core.judgement import fusion
from core.judgement.fusion import CameraRanking
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import packaged_xfeat
from core.places import PlaceFields, Pose
from core.recognition.question import Query, Question, Verify
from core.recognition.recognition import Answer, enrol
from core.recognition.rigs import locate_rig
from core.store import Directory, Map
from tests.service.scenes import jpeg, scene, seen_again

PLACES = 30


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return EncoderCatalogue().get(DEFAULT_ENCODER)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory, encoder: Encoder) -> Iterator[Map]:
    """A map of places of which each camera sees another side; one of them looks the same somewhere else."""
    atlas = Directory(tmp_path_factory.mktemp("maps"))
    made = atlas.create("lab", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    for seed in range(PLACES):
        for side, number in (("left", seed), ("right", seed + 100)):
            enrol(made, f"{side}-{seed}", jpeg(number), encoder, PlaceFields(pose=Pose(x=10 * seed, y=0)))
    enrol(made, "like-right-3", jpeg(103), encoder, PlaceFields(pose=Pose(x=1000, y=0)))
    yield made
    atlas.close()


def ask(map_: Map, encoder: Encoder, frames: list[Pixels], verify: Verify) -> Answer:
    find = partial(find_keypoints, packaged_xfeat())
    queries = [
        Query(encoder.encode(pixels), Question(PLACES, verify=verify), partial(find, pixels)) for pixels in frames
    ]
    return locate_rig(map_, encoder, queries)


@pytest.mark.thorough
def test_the_candidates_of_all_cameras_are_verified_where_those_of_one_are(
    lab: Map, encoder: Encoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[CameraRanking] = []
    real = fusion.fuse

    def fuse(views: list[CameraRanking], *rest: object) -> object:
        seen[:] = views
        return real(views, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr("core.recognition.rigs.fuse", fuse)
    clear, doubtful = seen_again(scene(3)), seen_again(scene(103))
    alone = [ask(lab, encoder, [one, one], "auto").third_stage.state for one in (clear, doubtful)]
    assert alone == ["not-needed", "verified"], "one of them leaves doubt, the other does not"
    answer = ask(lab, encoder, [clear, doubtful], "auto")
    assert answer.third_stage.state == "verified"
    counts = [0 if one.geometry is None else int((~np.isnan(one.geometry.evidence)).sum()) for one in seen]
    assert min(counts) > 1, counts
    always = ask(lab, encoder, [clear, doubtful], "always")
    assert [score for score, _ in answer.matches[:3]] == pytest.approx([score for score, _ in always.matches[:3]])
    assert answer.judgement.verdict == always.judgement.verdict
    assert ask(lab, encoder, [clear, clear], "auto").third_stage.state == "not-needed"
