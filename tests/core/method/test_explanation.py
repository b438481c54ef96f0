"""Explanations: the parts add up to the score, and a loss is what leaving a region out really costs."""

from __future__ import annotations

import numpy as np
import pytest

from core.method.catalogue import EncoderCatalogue
from core.method.encoder import Encoder, canary_frame
from core.method.explanation import Shown, explain
from core.method.regions import Regions
from core.method.vlad import aggregate


@pytest.fixture(scope="module", params=["m-region-vlad", "region-vlad"])
def encoder(request: pytest.FixtureRequest) -> Encoder:
    return EncoderCatalogue().get(request.param)


def shown(encoder: Encoder, shift: int = 0) -> Shown:
    encoding = encoder.encode(np.ascontiguousarray(np.roll(canary_frame(), shift, axis=1)))
    return Shown(encoding.descriptor, encoding.local, encoding.regions)


def kept(regions: Regions, left_out: int) -> np.ndarray:
    return np.delete(regions.features, left_out, axis=0)


def test_the_parts_add_up_to_the_score(encoder: Encoder) -> None:
    a = encoder.encode(canary_frame())
    b = encoder.encode(np.ascontiguousarray(np.roll(canary_frame(), 24, axis=1)))
    found = explain(encoder, Shown(a.descriptor, a.local, a.regions), Shown(b.descriptor, b.local, b.regions))
    assert found.score == pytest.approx(encoder.score(a, b), abs=1e-4)
    assert found.words.shape == (len(encoder.centers),)
    assert len(found.gains) == len(found.cells.query) and (found.gains >= 0).all()
    assert bool(len(found.gains)) == bool(encoder.candidates)


def test_a_loss_is_what_the_score_loses_without_the_region(encoder: Encoder) -> None:
    a, b = shown(encoder), shown(encoder, 24)
    losses = explain(encoder, a, b).losses[0]
    assert losses is not None and a.regions is not None
    definition = encoder.definition
    whole = encoder.scores_from_inner_products(np.array(a.descriptor @ b.descriptor))
    for region in (0, int(np.argmax(losses)), int(np.argmin(losses)), len(losses) - 1):
        less = aggregate(kept(a.regions, region), encoder.centers, definition.gamma, definition.normalization)
        without = encoder.scores_from_inner_products(np.array(less @ b.descriptor))
        assert losses[region] == pytest.approx(float(whole - without), abs=1e-5)


def test_a_frame_answers_itself_region_by_region(encoder: Encoder) -> None:
    a = shown(encoder)
    found = explain(encoder, a, a)
    assert a.regions is not None and len(found.answers) > 0
    features = a.regions.features
    for mine, other in found.answers:
        np.testing.assert_allclose(features[mine], features[other], atol=1e-6)
    assert (found.cells.query == found.cells.reference).all()


def test_a_place_without_a_picture_has_no_regions_to_name(encoder: Encoder) -> None:
    a, b = shown(encoder), shown(encoder, 24)
    found = explain(encoder, a, Shown(b.descriptor, b.local, None))
    assert found.losses[0] is not None and found.losses[1] is None
    assert found.answers.shape == (0, 2)
    np.testing.assert_allclose(found.words, explain(encoder, a, b).words, atol=1e-6)


def test_a_blank_frame_explains_nothing(encoder: Encoder) -> None:
    blank = encoder.encode(np.zeros((240, 320, 3), np.uint8))
    nothing = Shown(blank.descriptor, blank.local, blank.regions)
    found = explain(encoder, nothing, shown(encoder))
    assert found.score == 0 and len(found.answers) == 0 and len(found.gains) == 0
    assert found.losses[0] is not None and len(found.losses[0]) == 0
