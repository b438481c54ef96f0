"""ONNX Runtime's pass against torch's own, layer by layer; torch's precisions and devices."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition
from core.method.catalogue import PACKAGED
from core.networks.backbone import Array, Precision
from core.networks.forward import GraphPass, forward_pass
from core.networks.network import (
    Convolution,
    Layer,
    NetworkDefinition,
    Normalization,
    Pooling,
    Relu,
    caffenet_definition,
)
from core.networks.torch_network import TorchNetwork, as_array, as_tensor, load_torch_network
from core.threads import each

OUTPUTS = ("pool2", "conv3", "conv4")


def images(count: int, side: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).standard_normal((count, side, side, 3), np.float32)


def by_torch(network: TorchNetwork, shown: Array) -> list[Array]:
    with torch.inference_mode():
        return [as_array(output) for output in network(as_tensor(shown))]


def network_of(*layers: Layer, outputs: tuple[str, ...]) -> TorchNetwork:
    torch.manual_seed(0)
    shown = InputDefinition(height=33, width=33, mean=(0.0, 0.0, 0.0))
    definition = NetworkDefinition(name="small", input=shown, layers=layers)
    return TorchNetwork(definition, outputs).eval().requires_grad_(False)


def assert_same(network: TorchNetwork, shown: Array) -> None:
    made = GraphPass(network.as_data())(shown)
    for one, other in zip(made, by_torch(network, shown), strict=True):
        assert one.dtype == np.float32 and one.flags.c_contiguous
        np.testing.assert_allclose(one, other, atol=1e-5, rtol=1e-5)


@pytest.fixture(scope="module")
def packaged() -> TorchNetwork:
    return load_torch_network(PACKAGED / "placerec-hybrid.network.safetensors", OUTPUTS)


@pytest.mark.thorough
@pytest.mark.parametrize("count", [1, 3])
def test_the_packaged_network_gives_what_torch_gives(packaged: TorchNetwork, count: int) -> None:
    assert_same(packaged, images(count, 227))


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("before", [False, True])
def test_the_orders_of_caffenet_and_alexnet(normalize: bool, before: bool) -> None:
    torch.manual_seed(1)
    definition = caffenet_definition("c", normalize=normalize, norm_before_pool=before)
    assert_same(TorchNetwork(definition, ("conv2", "conv5", "pool1")).eval(), images(2, 227))


@pytest.mark.parametrize("slope", [0.0, 0.1])
def test_a_rectifier_behind_a_pooling(slope: float) -> None:
    """Caffe's quick network for CIFAR-10 has this order."""
    network = network_of(
        Convolution(name="a", channels=8, kernel=3, pad=1),
        Pooling(name="pool", method="max", kernel=3, stride=2),
        Relu(name="relu", negative_slope=slope),
        Convolution(name="b", channels=4, kernel=3),
        outputs=("pool", "a", "b"),
    )
    assert_same(network, images(2, 33))


def test_layers_may_have_the_names_of_the_graph_in_lower_case() -> None:
    network = network_of(Convolution(name="images", channels=4, kernel=3), Relu(name="nchw"), outputs=("images",))
    assert_same(network, images(1, 33))


def test_leaky_rectifiers_and_a_last_layer_without_rectifier() -> None:
    network = network_of(
        Convolution(name="a", channels=8, kernel=3, pad=1),
        Relu(name="leaky", negative_slope=0.1),
        Normalization(name="norm"),
        Convolution(name="b", channels=4, kernel=1),
        outputs=("b", "a", "b"),
    )
    assert_same(network, images(2, 33))


@pytest.mark.parametrize("method", ["max", "average"])
@pytest.mark.parametrize(
    ("kernel", "stride", "pad"), [(3, 2, 0), (2, 2, 0), (3, 3, 1), (2, 3, 1), (5, 1, 2), (3, 2, 1)]
)
@pytest.mark.parametrize("ceil", [False, True])
def test_pooling_is_torchs_own(method: str, kernel: int, stride: int, pad: int, ceil: bool) -> None:
    shape = {"kernel": kernel, "stride": stride, "pad": pad, "ceil": ceil}
    pooling = Pooling.model_validate({"name": "p", "method": method, **shape})
    network = network_of(Convolution(name="a", channels=5, kernel=1), pooling, outputs=("p",))
    for side in (7, 8, 12):
        assert_same(network, images(2, side)[:, :, 1:])


def test_threads_share_a_pass_and_a_frame_has_the_same_values_in_company(packaged: TorchNetwork) -> None:
    made, shown = GraphPass(packaged.as_data()), images(6, 227)
    together = made(shown)
    alone = each(lambda index: made(shown[index : index + 1]), range(6), 2)
    for index, outputs in enumerate(alone):
        for one, other in zip(outputs, together, strict=True):
            np.testing.assert_allclose(one[0], other[index], atol=1e-5, rtol=1e-5)


def test_what_cannot_be_computed_is_refused(capfd: pytest.CaptureFixture[str]) -> None:
    convolution = Convolution(name="a", channels=8, kernel=3)
    with pytest.raises(InvalidModel, match=r"\[1, 2, 2, 3\]"):
        GraphPass(network_of(convolution, outputs=("a",)).as_data())(images(1, 2))
    even = network_of(
        convolution, Normalization(name="n", size=4), Convolution(name="b", channels=1, kernel=1), outputs=("b",)
    )
    with pytest.raises(InvalidModel, match="'small' cannot be computed"):
        GraphPass(even.as_data())
    assert capfd.readouterr() == ("", ""), "the errors say it"


def test_bfloat16_comes_near_and_gives_float32(packaged: TorchNetwork) -> None:
    shown = images(1, 227)
    for made, wanted in zip(
        forward_pass(packaged.as_data(), "bfloat16")(shown), by_torch(packaged, shown), strict=True
    ):
        assert made.dtype == np.float32
        cosine = made.ravel() @ wanted.ravel() / np.linalg.norm(made) / np.linalg.norm(wanted)
        assert 0.9999 < cosine < 1 and not np.array_equal(made, wanted)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_pass_keeps_the_weights_that_it_was_made_of(precision: Precision) -> None:
    network = network_of(Convolution(name="a", channels=8, kernel=3), outputs=("a",))
    made = forward_pass(network.as_data(), precision)
    before = made(images(1, 33))[0].copy()
    with torch.inference_mode():
        for tensor in network.state_dict().values():
            tensor.zero_()
    np.testing.assert_array_equal(made(images(1, 33))[0], before)


def test_a_lower_precision_without_torch_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    network = network_of(Convolution(name="a", channels=8, kernel=3), outputs=("a",)).as_data()
    monkeypatch.delitem(sys.modules, "core.networks.torch_passes", raising=False)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InvalidModel, match="cpu in bfloat16 needs torch, which is not installed"):
        forward_pass(network, "bfloat16")
    assert forward_pass(network)(images(1, 33))[0].shape == (1, 31, 31, 8)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_machine_without_cuda_says_so() -> None:
    network = network_of(Convolution(name="a", channels=8, kernel=3), outputs=("a",))
    with pytest.raises(InvalidModel, match="CUDA"):
        forward_pass(network.as_data(), "float32", "cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_a_cuda_device_gives_what_the_processor_gives_to_many_threads() -> None:
    network = load_torch_network(PACKAGED / "placerec-hybrid.network.safetensors", OUTPUTS)
    shown, on_device = images(24, 227), forward_pass(network.as_data(), "float32", "cuda")

    def compute(index: int) -> tuple[Array, ...]:
        return on_device(shown[index : index + 1])

    wanted = by_torch(network, shown)
    for index, outputs in enumerate(each(compute, range(len(shown)), 8)):
        for made, other in zip(outputs, wanted, strict=True):
            np.testing.assert_allclose(made[0], other[index], atol=1e-3, rtol=1e-3)
