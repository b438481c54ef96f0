"""The shallow network: its layers against their formulas, its depth, its weights, its files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition
from core.networks.network import (
    Convolution,
    Layer,
    NetworkDefinition,
    Normalization,
    Pooling,
    Relu,
    caffenet_definition,
    read_definition,
    save_network,
)
from core.networks.torch_network import TorchNetwork, arrays_of, build_layer, load_torch_network

SHOWN = InputDefinition(height=35, width=43, mean=(104.0, 117.0, 123.0))


def little(*layers: Layer) -> NetworkDefinition:
    return NetworkDefinition(name="little", input=SHOWN, layers=layers)


LITTLE = little(
    Convolution(name="conv1", channels=8, kernel=5, stride=2),
    Relu(name="relu1"),
    Pooling(name="pool1", kernel=3, stride=2),
    Normalization(name="norm1"),
    Convolution(name="conv2", channels=6, kernel=3, pad=1, groups=2),
    Relu(name="relu2"),
    Convolution(name="conv3", channels=4, kernel=3),
    Relu(name="relu3"),
)


def random_weights(definition: NetworkDefinition, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    weights, channels = {}, 3
    for layer in definition.convolutions():
        shape = (layer.channels, channels // layer.groups, layer.kernel, layer.kernel)
        weight = torch.randn(shape, generator=generator) / math.sqrt(math.prod(shape[1:]))
        weights[f"{layer.name}.weight"] = weight
        weights[f"{layer.name}.bias"] = torch.randn(layer.channels, generator=generator)
        channels = layer.channels
    return weights


def run(definition: NetworkDefinition, weights: dict[str, Tensor], outputs: list[str], images: Tensor) -> list[Tensor]:
    network = TorchNetwork(definition, outputs)
    network.load_weights(weights)
    with torch.inference_mode():
        return list(network(images))


# Layers


@settings(max_examples=40)
@given(
    channels=st.integers(1, 12),
    half=st.integers(0, 3),
    alpha=st.floats(1e-5, 3),
    beta=st.floats(0.1, 2),
    k=st.floats(0.5, 3),
)
def test_normalization_follows_its_formula(channels: int, half: int, alpha: float, beta: float, k: float) -> None:
    size = 2 * half + 1
    x = np.random.default_rng(channels).standard_normal((channels, 3, 4)) * 3
    wanted = np.empty_like(x)
    for channel in range(channels):
        total = k
        for other in range(max(0, channel - half), min(channels, channel + half + 1)):
            total = total + alpha / size * x[other] ** 2
        wanted[channel] = x[channel] / total**beta
    layer = build_layer(Normalization(name="norm", size=size, alpha=alpha, beta=beta, k=k), channels)
    found = layer(torch.from_numpy(x)[None])[0].numpy()
    np.testing.assert_allclose(found, wanted, rtol=1e-9)


@settings(max_examples=60)
@given(
    height=st.integers(3, 20),
    width=st.integers(3, 20),
    kernel=st.integers(2, 3),
    stride=st.integers(1, 2),
    method=st.sampled_from(["max", "average"]),
    ceil=st.booleans(),
)
def test_pooling_takes_windows_that_reach_over_the_edge_when_it_rounds_up(
    height: int, width: int, kernel: int, stride: int, method: str, ceil: bool
) -> None:
    x = np.random.default_rng(height * 100 + width).standard_normal((height, width))
    rows, columns = (
        (math.ceil if ceil else math.floor)((size - kernel) / stride) + 1 for size in (height, width)
    )  # fmt: skip
    wanted = np.empty((rows, columns))
    for row in range(rows):
        for column in range(columns):
            window = x[row * stride : row * stride + kernel, column * stride : column * stride + kernel]
            wanted[row, column] = window.max() if method == "max" else window.mean()
    pooling = Pooling.model_validate(
        {"name": "pool", "method": method, "kernel": kernel, "stride": stride, "ceil": ceil}
    )
    np.testing.assert_allclose(build_layer(pooling, 1)(torch.from_numpy(x)[None, None])[0, 0].numpy(), wanted)


def test_a_leaky_rectifier() -> None:
    x = torch.tensor([[[[-2.0, 3.0]]]])
    assert build_layer(Relu(name="relu", negative_slope=0.1), 1)(x).flatten().tolist() == pytest.approx([-0.2, 3.0])


def caffenet(images: Tensor, w: dict[str, Tensor]) -> list[Tensor]:
    """CaffeNet up to conv5, written out (Jia et al., 2014)."""

    def pool(x: Tensor) -> Tensor:
        return functional.max_pool2d(x, 3, 2, ceil_mode=True)

    def norm(x: Tensor) -> Tensor:
        return functional.local_response_norm(x, 5, alpha=1e-4, beta=0.75, k=1.0)

    conv1 = functional.conv2d(images, w["conv1.weight"], w["conv1.bias"], stride=4).relu()
    conv2 = functional.conv2d(norm(pool(conv1)), w["conv2.weight"], w["conv2.bias"], padding=2, groups=2).relu()
    conv3 = functional.conv2d(norm(pool(conv2)), w["conv3.weight"], w["conv3.bias"], padding=1).relu()
    conv4 = functional.conv2d(conv3, w["conv4.weight"], w["conv4.bias"], padding=1, groups=2).relu()
    conv5 = functional.conv2d(conv4, w["conv5.weight"], w["conv5.bias"], padding=1, groups=2).relu()
    return [conv1, conv2, conv3, conv4, conv5]


def test_the_caffenet_layout_is_caffenet() -> None:
    definition = caffenet_definition("caffenet")
    weights = random_weights(definition)
    images = torch.rand(1, 3, 227, 227, generator=torch.Generator().manual_seed(1)) * 255 - 110
    names = [f"conv{number}" for number in range(1, 6)]
    found, wanted = run(definition, weights, names, images), caffenet(images, weights)
    shapes = [(96, 55, 55), (256, 27, 27), (384, 13, 13), (384, 13, 13), (256, 13, 13)]
    for ours, theirs, shape in zip(found, wanted, shapes, strict=True):
        assert ours.shape[1:] == shape
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5 * float(theirs.max()))


def test_alexnet_normalizes_before_it_pools() -> None:
    kinds = [layer.type for layer in caffenet_definition("alexnet", norm_before_pool=True).layers[:4]]
    assert kinds == ["convolution", "relu", "normalization", "pooling"]
    kinds = [layer.type for layer in caffenet_definition("caffenet").layers[:4]]
    assert kinds == ["convolution", "relu", "pooling", "normalization"]
    assert not any(isinstance(one, Normalization) for one in caffenet_definition("ours", normalize=False).layers)


# What is read from it


@pytest.mark.parametrize("outputs", [["conv1"], ["conv3", "conv1"], ["conv2", "conv3"], ["conv2", "conv2"]])
def test_outputs_are_rectified_and_come_in_the_order_wanted(outputs: list[str]) -> None:
    images = torch.randn(2, 3, 35, 43, generator=torch.Generator().manual_seed(2)) * 50
    found = run(LITTLE, random_weights(LITTLE), outputs, images)
    channels = {"conv1": 8, "conv2": 6, "conv3": 4}
    assert [one.shape[1] for one in found] == [channels[name] for name in outputs]
    for one in found:
        assert one.min() == 0
        assert one.max() > 0
        assert torch.isfinite(one).all()


def test_what_follows_an_output_does_not_change_it() -> None:
    images = torch.randn(1, 3, 35, 43, generator=torch.Generator().manual_seed(3)) * 50
    weights = random_weights(LITTLE)
    alone = [run(LITTLE, weights, [name], images)[0] for name in ("conv1", "conv2", "conv3")]
    for one, other in zip(alone, run(LITTLE, weights, ["conv1", "conv2", "conv3"], images), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


def test_the_images_are_left_as_they_are() -> None:
    images = torch.randn(1, 3, 35, 43)
    before = images.clone()
    run(LITTLE, random_weights(LITTLE), ["conv1"], images)
    assert torch.equal(images, before)


# How deep it is


def test_only_the_layers_in_use_are_built() -> None:
    network = TorchNetwork(LITTLE, ["conv2"])
    assert list(network.stages) == ["conv1", "relu1", "pool1", "norm1", "conv2", "relu2"]
    assert set(network.weights()) == {"conv1.weight", "conv1.bias", "conv2.weight", "conv2.bias"}
    assert [layer.name for layer in LITTLE.truncated(["conv1"]).layers] == ["conv1", "relu1"]


@pytest.mark.parametrize("outputs", [[], ["conv9"], ["relu1"], ["conv1", "norm1"]])
def test_only_convolutions_and_poolings_can_be_outputs(outputs: list[str]) -> None:
    with pytest.raises(InvalidModel):
        TorchNetwork(LITTLE, outputs)


def test_a_pooling_is_what_its_convolution_is_shrunk_to() -> None:
    torch.manual_seed(0)
    network = TorchNetwork(LITTLE, ["pool1", "conv2", "conv1"]).eval()
    shown = LITTLE.input
    with torch.no_grad():
        pooled, _, convolved = network(torch.rand(1, 3, shown.height, shown.width))
        torch.testing.assert_close(pooled, network.stages["pool1"](convolved))
    assert list(TorchNetwork(LITTLE, ["pool1"]).stages) == ["conv1", "relu1", "pool1"]


def test_the_weights_of_deeper_layers_are_not_needed() -> None:
    weights = {key: value for key, value in random_weights(LITTLE).items() if not key.startswith("conv3")}
    TorchNetwork(LITTLE, ["conv2"]).load_weights(weights)
    with pytest.raises(InvalidModel, match="conv3"):
        TorchNetwork(LITTLE, ["conv3"]).load_weights(weights)


@pytest.mark.parametrize("key", ["conv1.weight", "conv1.bias", "conv2.weight", "conv2.bias"])
def test_missing_misshapen_and_infinite_weights_are_refused_by_name(key: str) -> None:
    network = TorchNetwork(LITTLE, ["conv2"])
    weights = random_weights(LITTLE)
    infinite = weights[key].clone()
    infinite.view(-1)[0] = math.inf
    for bad in ({}, {key: weights[key][1:]}, {key: weights[key].unsqueeze(0)}, {key: infinite}):
        with pytest.raises(InvalidModel, match=key):
            network.load_weights({name: value for name, value in weights.items() if name != key} | bad)


def test_a_definition_needs_a_convolution_and_different_names() -> None:
    with pytest.raises(ValueError, match="convolution"):
        little(Relu(name="relu1"))
    with pytest.raises(ValueError, match="unique"):
        little(Convolution(name="a", channels=3, kernel=3), Relu(name="a"))


def test_the_description_changes_with_what_changes_an_activation_and_not_with_the_name() -> None:
    plain = TorchNetwork(LITTLE, ["conv2"]).describe()
    renamed = LITTLE.model_copy(update={"name": "other"})
    wider = LITTLE.model_copy(update={"input": SHOWN.model_copy(update={"width": 44})})
    stronger = little(*LITTLE.layers[:3], Normalization(name="norm1", alpha=2e-4), *LITTLE.layers[4:])
    assert TorchNetwork(renamed, ["conv2"]).describe() == plain
    assert TorchNetwork(wider, ["conv2"]).describe() != plain
    assert TorchNetwork(stronger, ["conv2"]).describe() != plain
    assert TorchNetwork(LITTLE, ["conv1"]).describe() != plain


# Its file


def test_a_network_comes_back_from_its_file(tmp_path: Path) -> None:
    path, weights = tmp_path / "little.network.safetensors", random_weights(LITTLE)
    save_network(path, LITTLE, arrays_of(weights))
    assert read_definition(path) == LITTLE
    network = load_torch_network(path, ["conv2"])
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())
    images = torch.randn(1, 3, 35, 43)
    with torch.inference_mode():
        wanted = run(LITTLE, weights, ["conv2"], images)[0]
        # The loaded network lies channels last in memory, which adds in another order.
        torch.testing.assert_close(network(images)[0], wanted, rtol=1e-4, atol=1e-5)
    for name, tensor in network.tensors().items():
        torch.testing.assert_close(tensor, weights[name], rtol=0, atol=0)


def test_files_that_are_no_networks_are_refused(tmp_path: Path) -> None:
    weights = random_weights(LITTLE)
    save_network(tmp_path / "whole", LITTLE, arrays_of(weights))
    (tmp_path / "cut").write_bytes((tmp_path / "whole").read_bytes()[:-10])
    (tmp_path / "text").write_bytes(b"not a network")
    (tmp_path / "empty").touch()
    save_file(weights, tmp_path / "bare")
    save_file(weights, tmp_path / "undefined", {"format": "placerec-network/1"})
    save_file(weights, tmp_path / "odd", {"format": "placerec-network/1", "definition": '{"layers": []}'})
    light = {key: value for key, value in arrays_of(weights).items() if key != "conv1.bias"}
    save_network(tmp_path / "light", LITTLE, light)
    for name in ("missing", "cut", "text", "empty", "bare", "undefined", "odd", "light"):
        with pytest.raises(InvalidModel):
            load_torch_network(tmp_path / name, ["conv2"])
