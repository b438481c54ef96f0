"""Parts of a frame that are no regions, whitening, and the encoders that others' networks make of them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from core.errors import InvalidModel
from core.frames.masks import Mask
from core.judgement.verdict import judge
from core.method.catalogue import EncoderCatalogue, save_encoder
from core.method.encoder import Encoder, canary_frame
from core.method.explanation import Shown, explain
from core.method.parts import cells, pooled
from core.method.vlad import aggregate
from core.method.whitening import Whitening, fit_whitening
from core.networks.description import NetworkDescription, checked
from core.networks.onnx_network import OnnxNetwork, save_onnx_network
from core.places import Neighborhood, Whereabouts
from core.recognition.encoder_calibration import measure_calibration
from lab.conversion.encoder_making import make_encoder
from tests.lab.conversion.onnx_writer import MAPS, onnx_network
from tests.service.scenes import scene, seen_again, stranger

SCENES = [scene(seed, 96, 72) for seed in range(30)]
GRAPH = onnx_network().SerializeToString()

AGGREGATIONS: dict[str, dict[str, object]] = {
    "gem": {"aggregation": {"method": "gem", "exponent": 2}, "output": {"kind": "maps", "rectify": True}},
    "whitened": {"aggregation": {"method": "gem", "whitening": 3}},
    "vlad": {"aggregation": {"method": "vlad", "words": 4}},
    "whitened-vlad": {"aggregation": {"method": "vlad", "words": 4, "whitening": 6}},
    "regions": {"aggregation": {"method": "regions", "words": 4, "regions": 30, "step": 0.5}},
    "two-stages": {
        "aggregation": {"method": "vlad", "words": 4},
        "second_stage": {"values": 4, "reach": [1, 1], "candidates": 5},
    },
}


def described(what: str) -> NetworkDescription:
    return checked(MAPS.model_dump() | AGGREGATIONS[what])


def encoder_of(what: str, graph: bytes = GRAPH) -> Encoder:
    return make_encoder(what, OnnxNetwork(what, graph, described(what)), lambda: SCENES, 0)[0]


def test_cells_are_parts_by_falling_length() -> None:
    maps = np.random.default_rng(0).normal(size=(3, 4, 5)).astype(np.float32)
    maps[1, 2] = 0
    found = cells([maps], 100)
    assert len(found) == 11 and (np.diff(found.energies) <= 0).all()
    for box, feature in zip(found.boxes, found.features, strict=True):
        top, left, bottom, right = box
        assert (bottom, right) == (top + 1, left + 1)
        np.testing.assert_array_equal(feature, maps[top, left])
    assert len(cells([maps], 4)) == 4 and len(cells([maps * 0], 4)) == 0


def test_the_generalized_mean() -> None:
    maps = np.array([[[1.0, -2.0], [3.0, 0.0]]], np.float32)  # 1 x 2 cells of 2 values
    found = pooled([maps, maps], 2)
    np.testing.assert_allclose(found.features[0], [np.sqrt((1 + 9) / 2), 1e-6], rtol=1e-5)
    assert found.boxes.tolist() == [[0, 0, 1, 2]] * 2 and found.layers.tolist() == [0, 1]
    assert len(pooled([maps * 0], 2)) == 0


@pytest.mark.parametrize("count", [5, 40])
def test_whitening_makes_the_variance_of_every_value_one(count: int) -> None:
    random = np.random.default_rng(0)
    descriptors = (random.normal(size=(count, 10)) @ random.normal(size=(10, 10)) + 3).astype(np.float32)
    whitening = fit_whitening(descriptors, 4)
    whitened = (descriptors - whitening.mean) @ whitening.matrix
    np.testing.assert_allclose(whitened.T @ whitened / count, np.eye(4), atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(whitening(descriptors), axis=1), 1, atol=1e-5)
    assert not whitening(np.zeros((1, 10), np.float32)).any()
    with pytest.raises(InvalidModel, match="do not differ in"):
        fit_whitening(np.repeat(descriptors[:2], 5, axis=0), 2)
    with pytest.raises(InvalidModel, match="not a finite mean"):
        Whitening(whitening.mean, whitening.matrix * np.nan)


@pytest.mark.parametrize("what", AGGREGATIONS)
def test_an_encoder_of_each_aggregation(what: str, tmp_path: Path) -> None:
    network = OnnxNetwork(what, GRAPH, described(what))
    encoder, vocabulary = make_encoder(what, network, lambda: SCENES, 0)
    encoder.calibration = measure_calibration(encoder, SCENES, "encoder-default")
    a, b = encoder.encode(SCENES[3]), encoder.encode(seen_again(SCENES[3]))
    others = [encoder.score(a, encoder.encode(frame)) for frame in SCENES[:3]]
    assert a.descriptor.shape == (encoder.dimension,) and a.local.shape == encoder.local_shape
    assert 1.0001 > encoder.score(a, a) > max(0.3, encoder.score(a, b), *others)

    blank = encoder.encode(np.zeros((50, 50, 3), np.uint8))
    assert not len(blank.regions) and not blank.descriptor.any() and not blank.local.any()
    hidden = encoder.encode(SCENES[3], Mask(polygons=(((0, 0), (0.5, 0), (0.5, 0.5), (0, 0.5)),)))
    assert not np.array_equal(hidden.descriptor, a.descriptor)

    sides = [Shown(one.descriptor, one.local, one.regions) for one in (a, b)]
    explanation = explain(encoder, *sides)
    assert explanation.score == pytest.approx(encoder.score(a, b), abs=1e-4)
    losses = explanation.losses[0]
    assert losses is not None and len(losses) == len(a.regions)
    less = np.delete(a.regions.features, 0, axis=0)
    without = aggregate(less, encoder.centers, encoder.definition.gamma, encoder.definition.normalization)
    if encoder.whitening is not None:
        without = encoder.whitening(without[np.newaxis])[0]
    scores = encoder.scores_from_inner_products(np.array([a.descriptor @ b.descriptor, without @ b.descriptor]))
    assert losses[0] == pytest.approx(float(scores[0] - scores[1]), abs=1e-4)

    save_onnx_network(tmp_path / f"{what}.network.safetensors", what, GRAPH, network.description)
    save_encoder(tmp_path, encoder, vocabulary, what, {})
    loaded = EncoderCatalogue(tmp_path).get(what)
    loaded.check_golden()
    assert loaded.identity == encoder.identity and loaded.calibration == encoder.calibration
    np.testing.assert_allclose(loaded.encode(SCENES[3]).descriptor, a.descriptor, atol=1e-6)


def test_the_calibration_tells_what_was_seen_from_what_was_not() -> None:
    encoder = encoder_of("vlad")
    vectors = np.stack([encoder.encode(frame).descriptor for frame in SCENES])
    neighborhood = Neighborhood(0.0, 0)

    def verdict(frame: np.ndarray) -> str:
        scores = encoder.scores_from_inner_products(encoder.encode(frame).descriptor @ vectors.T)
        order = np.argsort(-scores)
        return judge(scores[order], Whereabouts.along_sequence(order), encoder.calibration, neighborhood).verdict

    assert {verdict(frame) for frame in SCENES} == {"unknown"}  # not measured yet
    encoder.calibration = measure_calibration(encoder, SCENES, "encoder-default")
    assert encoder.calibration.geometry is not None and encoder.calibration.frames == len(SCENES)
    assert [verdict(frame) for frame in SCENES].count("recognized") > 25
    assert [verdict(stranger(seed)) for seed in range(100, 130)].count("recognized") < 10


def test_the_identity_covers_network_description_vocabulary_and_whitening() -> None:
    first = encoder_of("whitened-vlad")
    assert encoder_of("whitened-vlad").identity == first.identity
    network = OnnxNetwork("other", onnx_network().SerializeToString(), described("whitened-vlad"))
    shown = network.description.model_dump()
    brighter = checked(shown | {"input": shown["input"] | {"scale": (0.02, 0.02, 0.02)}})
    fewer = checked(shown | {"aggregation": shown["aggregation"] | {"whitening": 5}})
    model = onnx_network()
    model.graph.initializer[0].raw_data = model.graph.initializer[0].raw_data[:-1] + b"\x3e"
    others = [
        OnnxNetwork("other", GRAPH, brighter),
        OnnxNetwork("other", GRAPH, fewer),
        OnnxNetwork("other", model.SerializeToString(), network.description),
    ]
    made = [make_encoder("whitened-vlad", other, lambda: SCENES, 0)[0].identity for other in others]
    made.append(make_encoder("whitened-vlad", network, lambda: SCENES[::2], 0)[0].identity)
    made.append(make_encoder("whitened-vlad", network, lambda: SCENES, 1)[0].identity)
    assert len({first.identity, *made}) == 6


def test_a_network_file_that_was_exchanged_is_refused(tmp_path: Path) -> None:
    network = OnnxNetwork("gem", GRAPH, described("gem"))
    encoder, vocabulary = make_encoder("gem", network, list, 0)
    file = tmp_path / "gem.network.safetensors"
    save_encoder(tmp_path, encoder, vocabulary, "gem", {})
    model = onnx_network()
    model.graph.initializer[0].raw_data = model.graph.initializer[0].raw_data[:-1] + b"\x3e"
    save_onnx_network(file, "gem", model.SerializeToString(), network.description)
    with pytest.raises(InvalidModel, match=r"trained for the features|its contents are"):
        EncoderCatalogue(tmp_path).get("gem")
    save_onnx_network(file, "gem", GRAPH, network.description)
    shutil.copy(file, tmp_path / "copy.safetensors")
    assert EncoderCatalogue(tmp_path).get("gem").encode(canary_frame()).descriptor.any()
