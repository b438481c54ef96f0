"""An encoder with its first stage alone, and with geometric verification as a third."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.errors import InvalidModel, UnknownEncoder
from core.frames.images import decode
from core.judgement.geometry import AGREEMENT, INLIERS, SIMILARITY
from core.maps import MapSettings
from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
from core.places import PlaceFields
from core.recognition.question import Question, Verify
from core.recognition.recognition import enrol, recognize
from core.recognition.verification import CANDIDATES
from core.store import Directory
from lab.baselines.encoders import EncoderSystem
from lab.baselines.registry import build, systems
from lab.baselines.stages import VerifiedSystem, keypoints_in
from tests.service.scenes import blank, encoded, jpeg, scene, seen_again


@pytest.fixture(scope="module")
def models() -> EncoderCatalogue:
    return EncoderCatalogue()


def test_the_first_stage_gives_the_encoders_vectors_and_their_mean_cosines(models: EncoderCatalogue) -> None:
    system, encoder = build(f"{DEFAULT_ENCODER}.first-stage", models=models), models.get(DEFAULT_ENCODER)
    assert isinstance(system, EncoderSystem)
    frames = [scene(0), scene(1), seen_again(scene(0))]
    described, encoded = [system.describe(frame) for frame in frames], [encoder.encode(frame) for frame in frames]
    vectors = np.stack([one.descriptor for one in encoded])
    np.testing.assert_allclose(np.stack([one.arrays["descriptor"] for one in described]), vectors, atol=1e-5)
    assert all(set(one.arrays) == {"descriptor"} for one in described)
    scores = system.index(described).score(described)
    np.testing.assert_allclose(scores, vectors @ vectors.T / encoder.definition.words, atol=1e-5)
    assert system.encoder.calibration.curve is None  # the default's is of both stages


def test_names_and_titles_say_which_stages_there_are(models: EncoderCatalogue) -> None:
    titles = {about.name: about.title for about in systems(models)}
    assert titles[DEFAULT_ENCODER] == ("M-Region-VLAD with local agreement and verification where these leave doubt")
    assert titles[f"{DEFAULT_ENCODER}.two-stages"] == "M-Region-VLAD with local agreement"
    assert titles[f"{DEFAULT_ENCODER}.first-stage"] == "M-Region-VLAD, first stage alone"
    assert titles[f"{DEFAULT_ENCODER}.verified"] == "M-Region-VLAD with local agreement and verification"
    shown = {about.name: about.configuration for about in systems(models)}
    assert not any(name.startswith("agreement.") for name in shown[f"{DEFAULT_ENCODER}.first-stage"])
    assert shown[f"{DEFAULT_ENCODER}.verified"]["verification.candidates"] == CANDIDATES
    # Encoders of one stage have no others.
    assert "region-vlad" in titles and "region-vlad.first-stage" not in titles and "region-vlad.verified" not in titles


@pytest.mark.parametrize("ending", [".first-stage", ".two-stages", ".verified"])
def test_each_has_an_identity_of_its_own(ending: str, models: EncoderCatalogue) -> None:
    system = build(DEFAULT_ENCODER + ending, models=models)
    assert system.identity.startswith(f"{DEFAULT_ENCODER}{ending}@")
    assert system.identity == build(DEFAULT_ENCODER + ending, models=EncoderCatalogue()).identity


@pytest.mark.parametrize("name", ["region-vlad.verified", "nothing.verified", ".first-stage", "hog.verified"])
def test_only_encoders_of_two_stages_have_others(name: str, models: EncoderCatalogue) -> None:
    with pytest.raises(UnknownEncoder, match="no system"):
        build(name, models=models)


def test_variants_take_no_file_of_weights(models: EncoderCatalogue) -> None:
    with pytest.raises(InvalidModel, match="no file of weights"):
        build(f"{DEFAULT_ENCODER}.verified", models=models, weights=models.network_file("placerec-hybrid"))


def test_verification_weighs_the_parts_of_a_score_and_the_share_of_inliers(models: EncoderCatalogue) -> None:
    endings = (".first-stage", ".two-stages", ".verified")
    systems_ = [build(DEFAULT_ENCODER + ending, models=models) for ending in endings]
    assert isinstance(systems_[2], VerifiedSystem) and not systems_[2].sequential
    frames, query = [scene(0), scene(1), blank()], seen_again(scene(0))
    described = systems_[2].describe(frames[0])
    assert described.milliseconds["keypoints"] > 0
    places = [[one.describe(frame) for frame in frames] for one in systems_]
    first, both, scores = (
        one.index(some).score([one.describe(query)])[0] for one, some in zip(systems_, places, strict=True)
    )
    share = systems_[2].encoder.definition.agreement.share  # type: ignore[union-attr]
    similarity = (1 - share) * first
    gains = scores - both - SIMILARITY * similarity + AGREEMENT * (both - similarity)
    assert scores.shape == (3,) and scores.dtype == np.float32
    assert 0.05 < gains[0] <= INLIERS  # it shows the scene
    assert gains[1] < 0.5 * gains[0]  # another scene
    assert gains[2] == pytest.approx(0, abs=1e-6) and len(keypoints_in(places[2][2])) == 0


@pytest.mark.thorough
@pytest.mark.parametrize("verify", ["auto", "always", "never"])
def test_a_default_encoder_is_judged_by_what_the_service_answers(
    verify: Verify, models: EncoderCatalogue, tmp_path: Path
) -> None:
    """A map of the same frames, asked as the service asks it, orders its places by the same values."""
    encoder, system = models.get(DEFAULT_ENCODER), build(DEFAULT_ENCODER, models=models, verify=verify)
    assert isinstance(system, EncoderSystem) and system.identity == encoder.identity
    places = [jpeg(seed) for seed in (0, 1, 2, 3, 4, 5, 0)]
    queries = [encoded(seen_again(scene(seed))) for seed in (0, 3)] + [jpeg(40)]
    atlas = Directory(tmp_path)
    lab = atlas.create("lab", encoder.identity, encoder.dimension, MapSettings(keep="none"), encoder.local_shape)
    for number, picture in enumerate(places):
        enrol(lab, f"p{number}", picture, encoder, PlaceFields(sequence="walk"))
    answers = [recognize(lab, query, encoder, Question(verify=verify)) for query in queries]
    described = [[system.describe(decode(one)) for one in pictures] for pictures in (places, queries)]
    scores = system.index(described[0]).score(described[1])
    for row, answer in zip(scores, answers, strict=True):
        values = np.empty(len(places))
        values[answer.candidates.rows] = answer.candidates.values
        np.testing.assert_allclose(row, values, atol=0.01)  # a map keeps its vectors in half precision
    states = {answer.third_stage.state for answer in answers}
    assert states == {"never"} if verify == "never" else "verified" in states
    atlas.close()


@pytest.mark.thorough
def test_by_default_a_frame_in_doubt_is_verified_as_every_frame_may_be(models: EncoderCatalogue) -> None:
    systems_ = [build(DEFAULT_ENCODER, models=models, verify=verify) for verify in ("never", "auto", "always")]
    described = [systems_[1].describe(scene(seed)) for seed in range(24)]
    never, automatic, always = (system.index(described).score([described[5]])[0] for system in systems_)
    assert never.argmax() == automatic.argmax() == always.argmax() == 5
    np.testing.assert_allclose(automatic, always)  # so few places leave doubt
    assert always[5] != never[5]
