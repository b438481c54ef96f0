"""The third stage: which candidates are verified, in which order they end up, and what the verdict makes of it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from core.frames.images import decode
from core.geometry.detection import find_keypoints
from core.geometry.keypoints import LENGTH, Keypoints
from core.geometry.verification import Verification
from core.judgement.geometry import AGREEMENT, INLIERS, SIMILARITY
from core.judgement.verdict import Judgement
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.method.encoder import Encoder
from core.networks.xfeat import packaged_xfeat
from core.places import PlaceFields, Whereabouts
from core.recognition.question import Query, Question, Verifier, Verify
from core.recognition.recognition import Answer, describe, enrol, locate, recognize
from core.recognition.stages import Candidates
from core.recognition.verification import AT_FIRST, CANDIDATES, VerificationState, verify_candidates
from core.store import Directory, Map
from tests.service.scenes import jpeg, scene, seen_again

PLACES = 12


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return EncoderCatalogue().get(DEFAULT_ENCODER)


@pytest.fixture(scope="module")
def atlas(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Directory]:
    made = Directory(tmp_path_factory.mktemp("maps"))
    yield made
    made.close()


@pytest.fixture(scope="module")
def lab(atlas: Directory, encoder: Encoder) -> Map:
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
    candidates = answer.candidates
    assert candidates.geometry is not None and candidates.first is not None
    verified = int((~np.isnan(candidates.geometry.evidence)).sum())
    assert 1 <= verified <= CANDIDATES
    assert answer.judgement.verdict == "recognized" and answer.place is not None and answer.place.id == "p3"
    best = candidates.verifications[0]
    assert best is not None and best.evidence == answer.judgement.evidence and best.inlier_count > 20
    shares = [0 if one is None else one.inlier_share for one in candidates.verifications]
    shares += [0] * (len(candidates.rows) - len(shares))
    agreement = candidates.scores - candidates.first
    values = candidates.ordered + INLIERS * np.array(shares) + SIMILARITY * candidates.first - AGREEMENT * agreement
    np.testing.assert_allclose(candidates.values, values, rtol=1e-6)
    assert (np.diff(values) <= 0).all()
    assert [score for score, _ in answer.matches] == pytest.approx(values.tolist()), "the score is that of all stages"
    assert answer.judgement.score == pytest.approx(values[0])


def test_a_place_that_cannot_win_any_more_is_left_out(lab: Map, encoder: Encoder) -> None:
    found = ask(lab, encoder, 3, "always").candidates
    assert sum(one is not None for one in found.verifications) < CANDIDATES
    stranger = ask(lab, encoder, 40, "always").candidates
    assert sum(one is not None for one in stranger.verifications) > 1


@dataclass
class KnownComparison:
    """A comparison whose outcome is known: the shares of matches and of inliers of the places, by their rows.

    inliers: NaN for a place without keypoints.
    """

    matches: list[int]
    inliers: list[float]
    asked: list[int] = field(default_factory=list)

    def matches_at_a_glance(self, rows: Sequence[int]) -> NDArray[np.int64]:
        return np.array([self.matches[row] for row in rows], np.int64)

    def agreements(self, rows: Sequence[int]) -> NDArray[np.float32]:
        return np.zeros(len(rows), np.float32)

    def verifications(self, rows: Sequence[int]) -> list[Verification | None]:
        self.asked += rows
        inliers = [None if np.isnan(self.inliers[row]) else round(100 * self.inliers[row]) for row in rows]
        pairs, flags = np.zeros((100, 2), np.int64), np.arange(100)
        return [
            None if count is None else Verification((100, 100), pairs, flags < count, float(count), 0.5)
            for count in inliers
        ]


def compare(
    first: list[float],
    gains: list[float],
    comparison: KnownComparison,
    examined: int | None = None,
    state: VerificationState = "verified",
) -> Candidates:
    """The candidates of a query with known scores after all three stages; rows are numbers in ``first``."""
    similarity, gain = np.array(first, np.float32), np.array(gains, np.float32)
    order = np.argsort(-(similarity + gain), kind="stable")
    scores, count = (similarity + gain)[order], len(first)
    alone = Whereabouts.along_sequence(10 * np.arange(count)).take(order)
    seen = np.arange(count) < (count if examined is None else examined)
    candidates = Candidates(order, scores, similarity[order], alone, seen, None, scores, count)
    query = Keypoints(640, 480, np.zeros((100, 2), np.uint16), np.ones((100, LENGTH), np.int8))

    def judged(candidates: Candidates) -> Judgement:
        return Judgement("unknown", float(candidates.ordered[0]), 0.0, None, None, 0.3)

    calibration = EncoderCatalogue().get(DEFAULT_ENCODER).calibration
    found, _, stage = verify_candidates(candidates, judged, Verifier("always", lambda: query), calibration, comparison)
    assert stage.state == state
    return found


def test_what_matches_at_a_glance_is_verified_however_two_stages_rank_it() -> None:
    """Place 60 has moved far in the view: cells and descriptors say little, and keypoints find it."""
    first = list(np.linspace(0.2, 0.1, 99))
    comparison = KnownComparison([3] * 60 + [30] + [3] * 38, [0.0] * 60 + [0.5] + [0.0] * 38)
    found = compare(first, [0.02] * 99, comparison)
    assert found.rows[0] == 60 and len(set(comparison.asked)) == len(comparison.asked) <= CANDIDATES


def test_a_place_that_a_glance_leaves_no_chance_is_not_compared() -> None:
    """Place 2 fits so well that the last ones, of which few keypoints match at a glance, cannot come before it."""
    comparison = KnownComparison([30] * AT_FIRST + [2] * 4, [0.05, 0.04, 0.3] + [0.05] * 5)
    found = compare([0.2, 0.19, 0.18, 0.17, 0.16, 0.15, 0.14, 0.13], [0.0] * 8, comparison)
    assert found.rows[0] == 2 and comparison.asked == list(range(AT_FIRST))
    comparison = KnownComparison([60] * 8, [0.05, 0.04, 0.3] + [0.05] * 5)
    compare([0.2, 0.19, 0.18, 0.17, 0.16, 0.15, 0.14, 0.13], [0.0] * 8, comparison)
    assert sorted(comparison.asked) == list(range(8)), "many matches at a glance may be many inliers"


def test_keypoints_of_others_say_nothing_against_a_best_match_that_has_none() -> None:
    """Place 1 fits, as places beside the true one do, and comes first only if place 0 has keypoints that do not."""
    first, gains = [0.2, 0.19, 0.18], [0.0] * 3
    bare = KnownComparison([0, 30, 30], [np.nan, 0.3, 0.2])
    assert compare(first, gains, bare, state="no-keypoints").rows.tolist() == [0, 1, 2]
    assert compare(first, gains, KnownComparison([0, 30, 30], [0.0, 0.3, 0.2])).rows[0] == 1
    assert compare(first, gains, KnownComparison([30, 0, 30], [0.1, np.nan, 0.3])).rows[0] == 2


def test_the_best_of_the_first_stage_are_never_lost() -> None:
    """Place 70 is best by its descriptor; cells on a grid have put seventy others before it."""
    first = [0.1] * 70 + [0.16] + [0.1] * 20
    gains = [0.1] * 70 + [0.0] + [0.0] * 20
    comparison = KnownComparison([5] * 91, [0.02] * 70 + [0.3] + [0.02] * 20)
    assert compare(first, gains, comparison).rows[0] == 70


def test_whatever_comes_first_in_the_end_was_verified() -> None:
    """All that are chosen have cells that say much and geometry that says nothing, so that others come first."""
    first = [0.15] * 20 + [0.16, 0.159] + [0.158] * 20
    gains = [0.1] * 20 + [0.0] * 22
    comparison = KnownComparison([6] * 20 + [0] * 22, [0.0] * 42)
    found = compare(first, gains, comparison, examined=42)
    assert found.verifications[0] is not None and int(found.rows[0]) in comparison.asked


@pytest.mark.parametrize("seed", [3, 40])
def test_auto_verifies_as_always_does_where_doubt_is_left(lab: Map, encoder: Encoder, seed: int) -> None:
    answer, beside = (ask(lab, encoder, seed, verify) for verify in ("auto", "always"))  # so few places leave doubt
    assert answer.third_stage.state == "verified"
    assert answer.judgement == beside.judgement
    assert answer.candidates.rows.tolist() == beside.candidates.rows.tolist()
    assert sum(one is not None for one in answer.candidates.verifications) > 1, "not the best match alone"


def test_places_without_keypoints_are_left_where_two_stages_put_them(atlas: Directory, encoder: Encoder) -> None:
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
    assert [one is not None for one in answer.candidates.verifications] == [True], "the others have none"


@pytest.mark.parametrize("verify", ["auto", "always"])
def test_a_best_match_without_keypoints_loses_nothing_to_places_that_have_some(
    atlas: Directory, encoder: Encoder, verify: Verify
) -> None:
    """As in a map whose setting was changed: what places beside it share with the frame says nothing against it."""
    mixed = atlas.create(
        f"mixed-{verify}",
        encoder.identity,
        encoder.dimension,
        MapSettings(keep="none", verification=False),
        encoder.local_shape,
    )
    enrol(mixed, "p3", jpeg(3), encoder)
    mixed.edit({"verification": True})
    for seed in (0, 1, 2, 4):
        enrol(mixed, f"p{seed}", jpeg(seed), encoder)
    answer, without = ask(mixed, encoder, 3, verify), ask(mixed, encoder, 3, "never")
    assert without.matches[0][1].id == "p3"
    assert answer.third_stage.state == "no-keypoints" and answer.judgement == without.judgement
    assert [place.id for _, place in answer.matches] == [place.id for _, place in without.matches]
    assert ask(mixed, encoder, 1, "always").third_stage.state == "verified"


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


def test_twins_are_ambiguous_however_well_they_fit(atlas: Directory, encoder: Encoder) -> None:
    twins = atlas.create("twins", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    for place in ("here", "there"):
        enrol(twins, place, jpeg(5), encoder)
    answer = recognize(twins, jpeg(5), encoder, Question(verify="always"))
    assert answer.judgement.verdict == "ambiguous" and answer.judgement.evidence is not None
    assert {place for group in answer.rivals for place in group.places} <= {"here", "there"} and answer.rivals
