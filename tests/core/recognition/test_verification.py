"""The third stage: which candidates are verified, in which order they end up, and what the verdict makes of it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from core.frames.images import decode
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import Keypoints
from core.judgement import verdict
from core.judgement.geometry import WEIGHT
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import packaged_xfeat
from core.places import PlaceFields
from core.recognition.question import Query, Question, Verify
from core.recognition.recognition import Answer, describe, enrol, locate, recognize
from core.recognition.verification import CANDIDATES
from core.storage import Atlas, Map
from tests.service.scenes import jpeg, scene, seen_again

PLACES = 12


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return EncoderCatalogue().get(DEFAULT_ENCODER)


@pytest.fixture(scope="module")
def atlas(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Atlas]:
    made = Atlas(tmp_path_factory.mktemp("maps"))
    yield made
    made.close()


@pytest.fixture(scope="module")
def lab(atlas: Atlas, encoder: Encoder) -> Map:
    """A map of places of their own, with keypoints."""
    lab = atlas.create("lab", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    for seed in range(PLACES):
        enrol(lab, f"p{seed}", jpeg(seed), encoder)
    return lab


def ask(map_: Map, encoder: Encoder, seed: int, verify: Verify, looked: list[int] | None = None) -> Answer:
    """The answer to a place seen again; ``looked`` gets an item each time its keypoints are found."""
    pixels = seen_again(scene(seed))

    def find() -> Keypoints:
        if looked is not None:
            looked.append(seed)
        return find_keypoints(packaged_xfeat(), pixels)

    (answer,) = locate(map_, encoder, [Query(encoder.encode(pixels), Question(PLACES, verify=verify), find)])
    return answer


@pytest.mark.thorough
def test_never_is_the_answer_of_two_stages(lab: Map, encoder: Encoder) -> None:
    looked: list[int] = []
    asked = ask(lab, encoder, 3, "never", looked)
    (plain,) = locate(lab, encoder, [Query(encoder.encode(seen_again(scene(3))))])
    assert asked.judgement == plain.judgement and not looked
    assert asked.third_stage.state == plain.third_stage.state == "never"
    assert asked.candidates.geometry is None and asked.judgement.evidence is None


def test_always_verifies_the_best_candidates_and_orders_by_them(lab: Map, encoder: Encoder) -> None:
    looked: list[int] = []
    answer = ask(lab, encoder, 3, "always", looked)
    assert answer.third_stage.state == "verified" and looked == [3]
    geometry = answer.candidates.geometry
    assert geometry is not None and int((~np.isnan(geometry.share)).sum()) == CANDIDATES
    assert answer.judgement.verdict == "recognized" and answer.place is not None and answer.place.id == "p3"
    best = answer.candidates.verifications[0]
    assert best is not None and best.evidence == answer.judgement.evidence and best.inlier_count > 20
    values = answer.candidates.ordered + WEIGHT * np.nan_to_num(geometry.share)
    np.testing.assert_allclose(answer.candidates.values, values)
    assert (np.diff(values) <= 0).all()


def test_auto_stops_where_the_best_match_settles_the_answer(lab: Map, encoder: Encoder) -> None:
    answer = ask(lab, encoder, 3, "auto")  # a map of so few places leaves doubt
    assert answer.third_stage.state == "verified" and answer.judgement.verdict == "recognized"
    assert sum(one is not None for one in answer.candidates.verifications) == 1


def test_auto_looks_at_the_others_where_the_best_match_does_not_settle_it(
    lab: Map, encoder: Encoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verdict, "DOUBT", (0.0, 1.0))  # no evidence settles it, however a processor rounds
    answer = ask(lab, encoder, 40, "auto")
    assert answer.third_stage.state == "verified" and answer.judgement.verdict == "unknown"
    assert sum(one is not None for one in answer.candidates.verifications) == CANDIDATES


def test_places_without_keypoints_are_left_where_two_stages_put_them(atlas: Atlas, encoder: Encoder) -> None:
    bare = atlas.create(
        "plain", encoder.identity, encoder.dimension, MapSettings(keep="none", verification=False), encoder.local_shape
    )
    for seed in range(3):
        enrol(bare, f"p{seed}", jpeg(seed), encoder)
    looked: list[int] = []
    answer = ask(bare, encoder, 1, "always", looked)
    assert answer.third_stage.state == "no-keypoints" and not looked
    assert answer.judgement == ask(bare, encoder, 1, "never").judgement
    bare.edit({"verification": True})
    pixels = decode(jpeg(3))
    described = describe(
        bare, "p3", PlaceFields(), None, hashlib.sha256(b"p3").digest(), pixels, encoder.encode(pixels),
        keypoints=find_keypoints(packaged_xfeat(), pixels),
    )  # fmt: skip
    bare.enrol([described])
    answer = ask(bare, encoder, 3, "always", looked)
    assert answer.third_stage.state == "verified" and looked == [3]
    assert [one is not None for one in answer.candidates.verifications] == [True, False, False, False]


def test_a_frame_with_hardly_any_keypoints_is_judged_by_its_scores(lab: Map, encoder: Encoder) -> None:
    pixels = seen_again(scene(3))
    few = find_keypoints(packaged_xfeat(), pixels)
    few = Keypoints(few.width, few.height, few.positions[:7].copy(), few.descriptors[:7].copy())
    (answer,) = locate(lab, encoder, [Query(encoder.encode(pixels), Question(verify="always"), lambda: few)])
    assert answer.third_stage.state == "no-keypoints"
    assert answer.judgement == ask(lab, encoder, 3, "never").judgement


def test_recognize_verifies_by_itself(lab: Map, encoder: Encoder, tmp_path: Path) -> None:
    answer = recognize(lab, jpeg(5), encoder, Question(verify="always"))
    assert answer.third_stage.state == "verified" and answer.place is not None and answer.place.id == "p5"
    assert recognize(lab, jpeg(5), encoder, Question(verify="never")).third_stage.state == "never"


def test_twins_are_ambiguous_however_well_they_fit(atlas: Atlas, encoder: Encoder) -> None:
    twins = atlas.create("twins", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    for place in ("here", "there"):
        enrol(twins, place, jpeg(5), encoder)
    answer = recognize(twins, jpeg(5), encoder, Question(verify="always"))
    assert answer.judgement.verdict == "ambiguous" and answer.judgement.evidence is not None
    assert {place for group in answer.rivals for place in group.places} <= {"here", "there"} and answer.rivals
