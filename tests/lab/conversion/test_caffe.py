"""Import of Caffe networks, held to OpenCV's importer: a second implementation of Caffe's forward pass."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from core.errors import InvalidModel
from core.networks.network import Convolution, Normalization, Pooling, Relu, save_network
from core.networks.torch_network import TorchNetwork, arrays_of, load_torch_network
from lab.conversion.caffe import import_caffe
from tests.lab.conversion import in_process
from tests.lab.conversion.caffe_writer import (
    HEAD,
    Array,
    Layer,
    caffemodel,
    convolution,
    field,
    input_dim,
    layer,
    prototxt,
    relu,
    repeated,
    small_network,
    varint,
)

NAMES = [f"conv{number}" for number in range(1, 7)]


@pytest.fixture
def imported(tmp_path: Path) -> Callable[..., Any]:
    def run(content: bytes, mean: Any = (104.0, 117.0, 123.0), **options: Any) -> Any:
        (tmp_path / "Small Net.caffemodel").write_bytes(content)
        np.save(tmp_path / "mean.npy", np.array(mean))
        return import_caffe(tmp_path / "Small Net.caffemodel", tmp_path / "mean.npy", **options)

    return run


def with_opencv(layers: list[Layer], content: bytes, images: Array) -> list[Array]:
    net = cv2.dnn.readNetFromCaffe(
        np.frombuffer(prototxt(layers, images.shape), np.uint8), np.frombuffer(content, np.uint8)
    )
    net.enableFusion(False)
    net.setInput(images)
    return [np.asarray(output) for output in net.forward([f"relu{number}" for number in range(1, 7)])]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("generation", "form"), [("new", "new"), ("old", "old"), ("new", "double"), ("new", "unpacked")]
)
@pytest.mark.parametrize("norm_first", [False, True])
@pytest.mark.parametrize("size", [(47, 61), (64, 50)])
def test_the_outputs_are_those_of_opencv(
    imported: Any, generation: str, form: str, norm_first: bool, size: tuple[int, int]
) -> None:
    layers = small_network(norm_first)
    images = np.random.default_rng(0).uniform(-1.2, 1.5, (2, 3, *size)).astype(np.float32)
    wanted = with_opencv(layers, caffemodel(layers), images)

    definition, weights = imported(caffemodel(layers + HEAD, generation, form, input_dim(1, 3, *size)))
    network = TorchNetwork(definition, NAMES)
    network.load_weights(weights)
    with torch.inference_mode():
        found = network(torch.from_numpy(images))
    for ours, theirs in zip(found, wanted, strict=True):
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours.numpy(), theirs, rtol=1e-5, atol=2e-6 * np.abs(theirs).max())
        assert np.abs(theirs).max() > 0.1


def test_weights_and_description_are_taken_exactly(imported: Any) -> None:
    layers = small_network()
    definition, weights = imported(caffemodel(layers, start=input_dim(10, 3, 47, 61)))
    assert definition.name == "small-net"
    assert (definition.input.height, definition.input.width) == (47, 61)
    assert (definition.input.channel_order, definition.input.scale) == ("bgr", (1.0, 1.0, 1.0))
    assert [one.name for one in definition.layers] == [one["name"] for one in layers]
    assert definition.layers[:4] == (
        Convolution(name="conv1", channels=8, kernel=5, stride=2),
        Relu(name="relu1"),
        Pooling(name="shrink1a", kernel=3, stride=2),
        Normalization(name="shrink1b", size=5, alpha=float(np.float32(0.4)), beta=0.75),
    )
    assert definition.layers[6] == Pooling(name="pool2", method="average", kernel=3, stride=2, pad=1)
    assert definition.layers[11] == Relu(name="relu4", negative_slope=float(np.float32(0.1)))
    assert set(weights) == {f"{name}.{kind}" for name in NAMES for kind in ("weight", "bias")}
    for one in layers:
        for kind, values in zip(("weight", "bias"), one["blobs"], strict=False):
            tensor = weights[f"{one['name']}.{kind}"]
            assert tensor.dtype == torch.float32
            np.testing.assert_array_equal(tensor.numpy(), values)
    np.testing.assert_array_equal(weights["conv5.bias"].numpy(), np.zeros(6))


def test_an_imported_network_can_be_stored_as_a_file(imported: Any, tmp_path: Path) -> None:
    definition, weights = imported(caffemodel(small_network() + HEAD, start=input_dim(1, 3, 47, 61)))
    save_network(tmp_path / "small.network.safetensors", definition, arrays_of(weights))
    network = load_torch_network(tmp_path / "small.network.safetensors", ["conv3"])
    assert set(network.weights()) == {f"conv{n}.{kind}" for n in (1, 2, 3) for kind in ("weight", "bias")}
    assert torch.equal(network.tensors()["conv3.weight"], weights["conv3.weight"])


PLAIN = [convolution("conv1", "data", 3, 4, 3), relu("relu1", "conv1")]


@pytest.mark.thorough
@pytest.mark.parametrize("generation", ["new", "old"])
def test_a_training_network_says_its_crop_mean_and_scale(tmp_path: Path, generation: str) -> None:
    transform = {"scale": 0.5, "crop_size": 32, "mean_value": [104.0, 117.0, 123.0]}
    content = caffemodel(
        [layer("data", "Data", top="data label", transform_param=transform), *PLAIN, *HEAD], generation
    )
    (tmp_path / "net.caffemodel").write_bytes(content)
    shown = import_caffe(tmp_path / "net.caffemodel", name="trained")[0].input
    assert (shown.height, shown.width, shown.mean, shown.scale) == (32, 32, (104.0, 117.0, 123.0), (0.5, 0.5, 0.5))


def test_the_crop_and_scale_of_older_data_layers(imported: Any) -> None:
    data = layer("data", "Data", top="data label", data_param={"scale": 0.25, "crop_size": 33})
    shown = imported(caffemodel([data, *PLAIN], "old"))[0].input
    assert (shown.height, shown.width, shown.scale) == (33, 33, (0.25, 0.25, 0.25))


@pytest.mark.thorough
def test_the_input_layer_comes_before_the_crop_and_the_argument_before_both(imported: Any) -> None:
    shape = field(1, b"".join(varint(side) for side in (1, 3, 40, 50)))
    described = field(1, "data") + field(2, "Input") + field(4, "data") + field(143, field(1, shape))
    content = caffemodel(PLAIN, start=field(100, described + field(100, field(3, 32))))
    assert (imported(content)[0].input.height, imported(content)[0].input.width) == (40, 50)
    assert imported(content, input_size=(20, 30))[0].input.width == 30


def test_an_input_shape_outside_the_layers(imported: Any) -> None:
    start = field(3, "data") + field(8, repeated(1, [1, 3, 40, 50]))
    assert imported(caffemodel(PLAIN, start=start))[0].input.height == 40


def test_floor_pooling_and_the_offset_of_a_normalization(imported: Any) -> None:
    layers = [
        *PLAIN,
        layer("pool1", "Pooling", "conv1", pooling_param={"kernel_size": 3, "stride": 2, "round_mode": 1}),
        layer("norm1", "LRN", "pool1", lrn_param={"k": 2.0}),
    ]
    definition, _ = imported(caffemodel(layers, start=input_dim(1, 3, 32, 32)))
    assert definition.layers[2:] == (
        Pooling(name="pool1", kernel=3, stride=2, ceil=False),
        Normalization(name="norm1", size=5, alpha=1.0, beta=0.75, k=2.0),
    )


def test_what_branches_off_behind_a_split_is_left_out(imported: Any) -> None:
    layers = [
        *PLAIN,
        layer("split", "Split", "conv1", "conv1_a conv1_b"),
        layer("side", "InnerProduct", "conv1_a", inner_product_param={"num_output": 2}),
        layer("side_loss", "SoftmaxWithLoss", "side label", "side_loss"),
        convolution("conv2", "conv1_b", 4, 5, 3),
    ]
    definition, _ = imported(caffemodel(layers, start=input_dim(1, 3, 32, 32)))
    assert [one.name for one in definition.layers] == ["conv1", "relu1", "conv2"]


def test_the_mean_file_comes_before_the_mean_that_the_model_names(imported: Any) -> None:
    data = layer("data", "Data", top="data label", transform_param={"crop_size": 32, "mean_value": [7.0]})
    assert imported(caffemodel([data, *PLAIN]), (1.0, 2.0, 3.0))[0].input.mean == (1.0, 2.0, 3.0)


# What is refused

POOL = {"kernel_size": 3, "stride": 2}
REFUSED: dict[str, tuple[list[Layer], str]] = {
    "unknown type": ([*PLAIN, layer("bn1", "BatchNorm", "conv1")], r"bn1.*BatchNorm"),
    "within channel": ([*PLAIN, layer("norm1", "LRN", "conv1", lrn_param={"norm_region": 1})], "norm1.*within"),
    "even size": ([*PLAIN, layer("norm1", "LRN", "conv1", lrn_param={"local_size": 4})], "norm1.*odd"),
    "stochastic": ([*PLAIN, layer("pool1", "Pooling", "conv1", pooling_param=POOL | {"pool": 2})], "pool1"),
    "gaps": ([*PLAIN, layer("pool1", "Pooling", "conv1", pooling_param={"kernel_size": 1, "stride": 2})], "pool1"),
    "oblong": ([convolution("conv1", "data", 3, 4, 3, pad_h=1, pad_w=2)], "conv1.*pad"),
    "no kernel": ([*PLAIN, layer("pool1", "Pooling", "conv1", pooling_param={"stride": 2})], "pool1.*kernel"),
    "dilated": ([convolution("conv1", "data", 3, 4, 3, dilation=2)], "conv1.*dilated"),
    "groups": ([convolution("conv1", "data", 3, 4, 3, group=3)], "conv1.*groups"),
    "fork": ([*PLAIN, convolution("a", "conv1", 4, 4, 3), convolution("b", "conv1", 4, 4, 3)], "'b'.*forks"),
    "sum": ([*PLAIN, convolution("a", "conv1", 4, 4, 3), layer("sum", "Eltwise", "conv1 a")], "sum"),
    "too deep": ([*PLAIN, convolution("conv2", "conv1", 4, 4, 31)], "conv2.*larger"),
    "no convolution": ([relu("relu1", "data")], "convolution"),
    "name": ([convolution("conv.1", "data", 3, 4, 3)], "name"),
    "twice": ([*PLAIN, convolution("relu1", "conv1", 4, 4, 3)], "unique"),
    "channels": ([*PLAIN, convolution("conv2", "conv1", 5, 4, 3)], "conv2.*shape"),
    "no weights": (
        [layer("conv1", "Convolution", "data", convolution_param={"num_output": 4, "kernel_size": 3})],
        "conv1",
    ),
}


@pytest.mark.thorough
@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_said_exactly_is_refused_by_name(imported: Any, case: str) -> None:
    layers, reason = REFUSED[case]
    with pytest.raises(InvalidModel, match=reason):
        imported(caffemodel(layers, start=input_dim(1, 3, 32, 32)))


@pytest.mark.thorough
def test_what_the_files_do_not_say_must_be_given(tmp_path: Path) -> None:
    path = tmp_path / "net.caffemodel"
    path.write_bytes(caffemodel(PLAIN))
    with pytest.raises(InvalidModel, match="input size"):
        import_caffe(path)
    with pytest.raises(InvalidModel, match="mean"):
        import_caffe(path, input_size=(32, 32))
    path.write_bytes(caffemodel(PLAIN, start=input_dim(1, 1, 32, 32)))
    with pytest.raises(InvalidModel, match="3 channels"):
        import_caffe(path)
    path.write_bytes(field(2, field(1, field(1, "conv1"))))
    with pytest.raises(InvalidModel, match="first format"):
        import_caffe(path)


@pytest.mark.thorough
@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", b"PK\3\4", bytes(100)])
def test_other_files_are_refused(imported: Any, content: bytes) -> None:
    with pytest.raises(InvalidModel):
        imported(content)


def test_weights_that_are_not_finite_are_refused(imported: Any) -> None:
    broken = convolution("conv1", "data", 3, 4, 3)
    broken["blobs"][0][0, 0, 0, 0] = np.inf
    with pytest.raises(InvalidModel, match="finite"):
        imported(caffemodel([broken], start=input_dim(1, 3, 32, 32)))


TARGETS = [
    caffemodel(small_network() + HEAD, one, form, input_dim(1, 3, 47, 61))
    for one, form in (("new", "new"), ("old", "old"))
]


@pytest.mark.thorough
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(TARGETS), st.data())
def test_a_mutated_model_is_refused_or_imported(
    imported: Any, monkeypatch: pytest.MonkeyPatch, content: bytes, draw: st.DataObject
) -> None:
    in_process.use(monkeypatch, "lab.conversion.caffemodel")
    mutated = bytearray(content)
    for _ in range(draw.draw(st.integers(1, 5))):
        # Descriptions are short and weights long: most changes are made where the descriptions are.
        near = draw.draw(st.sampled_from([b"conv", b"relu", b"pool", b"norm", b"data", b""]))
        starts = [place for place in range(len(mutated)) if mutated.startswith(near, place)] or [0]
        place = max(draw.draw(st.sampled_from(starts)) + draw.draw(st.integers(-12, 40)), 0)
        added = draw.draw(st.binary(min_size=1, max_size=3))
        # A change of length breaks every message around it; most changes should get further than that.
        removed = draw.draw(st.sampled_from([len(added)] * 4 + [0]))
        mutated[place : place + removed] = added
    try:
        definition, weights = imported(bytes(mutated))
    except InvalidModel:
        return
    TorchNetwork(definition, [one.name for one in definition.convolutions()]).load_weights(weights)
