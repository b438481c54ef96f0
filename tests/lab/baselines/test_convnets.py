"""Networks in little, in Caffe's files, whose convolutions hand on what they see, so that all is told by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import InvalidModel, MissingWeights
from core.method.catalogue import EncoderCatalogue
from core.networks.network import save_network
from core.networks.torch_network import arrays_of
from lab.baselines import registry
from lab.baselines.convnets import ALEXNET, AMOSNET, HYBRIDNET, PLACES365, Differences
from lab.baselines.system import Description, System
from lab.conversion.caffe import import_caffe
from tests.lab.conversion.caffe_writer import Layer, caffemodel, field, layer, relu

Array = NDArray[Any]
MEAN = (10.0, 20.0, 30.0)
FRAME = np.random.default_rng(0).integers(0, 256, (227, 227, 3), np.uint8)
SEEN = np.maximum(FRAME.astype(np.float64) - MEAN, 0)  # 227 x 227 x 3


def plain(name: str, bottom: str, factor: float = 1) -> list[Layer]:
    """A convolution that multiplies, and its rectifier."""
    blobs = (factor * np.eye(3, dtype=np.float32)[:, :, None, None], np.zeros(3, np.float32))
    sides = {"num_output": 3, "kernel_size": 1}
    return [layer(name, "Convolution", bottom, blobs=blobs, convolution_param=sides), relu(f"relu_{name}", name)]


def trunk(last: int = 5) -> list[Layer]:
    layers: list[Layer] = []
    for number in range(1, last + 1):
        layers += plain(f"conv{number}", f"conv{number - 1}" if number > 1 else "data", 2 if number == 3 else 1)
    return layers


def build(name: str, path: Path) -> System:
    return registry.build(name, models=EncoderCatalogue(), weights=path)


def write(path: Path, layers: list[Layer], mean: str | None = None, **options: Any) -> Path:
    path.write_bytes(caffemodel(layers, **options))
    if mean is not None:
        np.save(path.parent / mean, np.array(MEAN))
    return path


def vector(system: System, frame: NDArray[np.uint8]) -> Array:
    return np.asarray(system.describe(frame).arrays["descriptor"])


def unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


# AlexNet


@pytest.mark.parametrize("generation", ["new", "old"])
def test_alexnet_is_conv3_by_the_cosine(tmp_path: Path, generation: str) -> None:
    path = write(tmp_path / "bvlc_alexnet.caffemodel", trunk(), "ilsvrc_2012_mean.npy", generation=generation)
    system = build("alexnet", path)
    found = system.describe(FRAME)
    np.testing.assert_allclose(np.asarray(found.arrays["descriptor"]), unit(SEEN.reshape(-1)), atol=1e-6)
    darker = system.describe(np.asarray(FRAME // 2, np.uint8))
    scores: Array = system.index([found, darker]).score([found])
    half = unit(np.maximum(FRAME // 2 - np.array(MEAN), 0).reshape(-1))
    assert scores.tolist() == [[pytest.approx(1), pytest.approx(unit(SEEN.reshape(-1)) @ half, abs=1e-5)]]


def test_alexnet_takes_imagenets_mean_where_no_file_says_another(tmp_path: Path) -> None:
    system = build("alexnet", write(tmp_path / "bvlc_alexnet.caffemodel", trunk()))
    wanted = np.maximum(FRAME - np.array([104.00699, 116.66877, 122.67892]), 0)
    np.testing.assert_allclose(vector(system, FRAME), unit(wanted.reshape(-1)), atol=1e-6)


def test_a_network_file_that_was_imported_before_is_taken_too(tmp_path: Path) -> None:
    path = write(tmp_path / "a.caffemodel", trunk(), "a_mean.npy")
    definition, weights = import_caffe(path, MEAN, input_size=(227, 227))
    save_network(tmp_path / "a.network.safetensors", definition, arrays_of(weights))
    ours, theirs = (build("alexnet", tmp_path / name) for name in ("a.network.safetensors", "a.caffemodel"))
    np.testing.assert_allclose(vector(ours, FRAME), vector(theirs, FRAME), atol=1e-6)
    assert ours.identity == theirs.identity


def test_a_blank_frame_has_a_description(tmp_path: Path) -> None:
    path = write(tmp_path / "a.caffemodel", trunk(), "a_mean.npy")
    for name in ("alexnet", "hybridnet"):
        system = build(name, path)
        blank = system.describe(np.full((50, 60, 3), 200, np.uint8))
        assert not blank.arrays["descriptor"].any()
        assert np.isfinite(system.index([blank]).score([blank, system.describe(FRAME)])).all()


# AMOSNet and HybridNet


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "model", "mean"),
    [
        ("amosnet", "AmosNet.caffemodel", "amosnet_mean.npy"),
        ("hybridnet", "HybridNet.caffemodel", "hybridnet_mean.npy"),
        ("hybridnet", "HybridNet.caffemodel", "amosnet_mean.npy"),
    ],
)
def test_a_spatial_pyramid_of_conv5(tmp_path: Path, name: str, model: str, mean: str) -> None:
    system = build(name, write(tmp_path / model, trunk(6), mean))
    found = vector(system, FRAME)
    maps = 2 * SEEN
    wanted = [maps.max((0, 1))]
    for level in (2, 3, 4):
        edges = [(i * 227 // level, -(-(i + 1) * 227 // level)) for i in range(level)]
        wanted += [maps[top:bottom, left:right].max((0, 1)) for top, bottom in edges for left, right in edges]
    np.testing.assert_allclose(found, np.concatenate(wanted), rtol=1e-6)
    assert found.shape == (30 * 3,)


def test_scores_fall_with_the_differences() -> None:
    references = np.array([[0, 0, 0], [65536, 0, -65536]], np.float32)
    queries = [Description({"descriptor": np.array(values, np.float32)}) for values in ([0, 0, 0], [65536, 32768, 0])]
    assert Differences(references).score(queries).tolist() == [[1, -1], [-0.5, -0.5]]


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["amosnet", "hybridnet", "places365"])
def test_a_missing_mean_is_named(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / "Net.caffemodel", [*trunk(), *fully_connected()])
    with pytest.raises(MissingWeights, match=r"Net\.caffemodel needs its mean file too; .* as Net_mean\.npy or "):
        build(name, path)


def test_a_mean_that_the_model_names_itself(tmp_path: Path) -> None:
    data = layer("data", "Data", top="data label", transform_param={"mean_value": list(MEAN)})
    system = build("hybridnet", write(tmp_path / "Net.caffemodel", [data, *trunk()]))
    assert vector(system, FRAME)[0] == pytest.approx(2 * SEEN[:, :, 0].max())


def test_networks_without_the_layer(tmp_path: Path) -> None:
    path = write(tmp_path / "a.caffemodel", trunk(2), "a_mean.npy")
    with pytest.raises(InvalidModel, match="named conv3"):
        build("alexnet", path)
    path.write_bytes(field(1, "nothing"))
    with pytest.raises(InvalidModel):
        build("hybridnet", path)


# Places365


def fully_connected(values: int = 12) -> list[Layer]:
    """pool5 to 2 x 2 cells, fc6 to four values of which one is negative, fc7 to three."""
    pool = {"pool": 0, "kernel_size": 114, "stride": 114}
    fc6 = np.zeros((4, values), np.float32)
    fc6[0, 0], fc6[1, 5], fc6[2, values - 1], fc6[3, 3] = 1, 1, 2, -1
    fc7 = np.array([[1, 0, 0, 0], [0, 1, -1, 5], [1, 1, 1, 1]], np.float32)
    blobs6, blobs7 = (fc6, np.array([0, 1, 0, 0], np.float32)), (fc7, np.array([0, 0, -7], np.float32))
    return [
        layer("pool5", "Pooling", "conv5", pooling_param=pool),
        layer("fc6", "InnerProduct", "pool5", blobs=blobs6, inner_product_param={"num_output": 4}),
        relu("relu6", "fc6"),
        layer("drop6", "Dropout", "fc6", "fc6"),
        layer("fc7", "InnerProduct", "fc6", blobs=blobs7, inner_product_param={"num_output": 3}),
        relu("relu7", "fc7"),
        layer("fc8", "InnerProduct", "fc7", blobs=(np.ones((9, 3), np.float32), np.zeros(9, np.float32))),
    ]


@pytest.mark.thorough
@pytest.mark.parametrize(("generation", "form"), [("new", "new"), ("old", "old")])
def test_places365_is_fc7_by_the_cosine(tmp_path: Path, generation: str, form: str) -> None:
    path = tmp_path / "alexnet_places365.caffemodel"
    write(path, trunk() + fully_connected(), "places365CNN_mean.npy", generation=generation, form=form)
    (tmp_path / "places365CNN_mean.npy").rename(tmp_path / "alexnet_places365_mean.npy")
    system = build("places365", path)
    found = vector(system, FRAME)
    maps = 2 * SEEN
    blue, green, red = ([maps[y, x, k].max() for y in HALVES for x in HALVES] for k in range(3))
    fc6 = [blue[0], green[1] + 1, 2 * red[3], 0]  # cells row by row, channel by channel: 5 is green's second
    fc7 = [fc6[0], max(fc6[1] - fc6[2], 0), sum(fc6) - 7]
    np.testing.assert_allclose(found, unit(np.array(fc7)), atol=1e-6)
    assert system.index([Description({"descriptor": found})]).score([system.describe(FRAME)])[0, 0] == pytest.approx(1)


HALVES = (slice(0, 114), slice(114, 227))


@pytest.mark.thorough
def test_fully_connected_layers_that_do_not_fit(tmp_path: Path) -> None:
    path = write(tmp_path / "a.caffemodel", trunk() + fully_connected(values=13), "a_mean.npy")
    with pytest.raises(InvalidModel, match=r"a\.caffemodel: fc6 does not fit the maps"):
        build("places365", path)
    write(path, trunk())
    with pytest.raises(InvalidModel, match="no fully connected layer fc6"):
        build("places365", path)


def test_each_says_which_file_it_needs() -> None:
    for about in (ALEXNET, AMOSNET, HYBRIDNET, PLACES365):
        assert about.weights is not None and ".caffemodel" in about.weights
    assert ALEXNET.configuration["layer"] == "conv3"
