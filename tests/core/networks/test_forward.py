"""ONNX Runtime's pass against torch's own, layer by layer; torch's precisions and devices."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch import nn

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition
from core.method.catalogue import PACKAGED
from core.networks.forward import GraphPass, TorchPass, cuda_pass
from core.networks.network import (
    Convolution,
    Layer,
    NetworkDefinition,
    Normalization,
    Pooling,
    Relu,
    ShallowNetwork,
    caffenet_definition,
    load_network,
)
from core.threads import each

OUTPUTS = ("pool2", "conv3", "conv4")


def images(count: int, side: int, seed: int = 0) -> torch.Tensor:
    made = torch.randn(count, 3, side, side, generator=torch.Generator().manual_seed(seed))
    return made.contiguous(memory_format=torch.channels_last)


def network_of(*layers: Layer, outputs: tuple[str, ...]) -> ShallowNetwork:
    torch.manual_seed(0)
    shown = InputDefinition(height=33, width=33, mean=(0.0, 0.0, 0.0))
    definition = NetworkDefinition(name="small", input=shown, layers=layers)
    return ShallowNetwork(definition, outputs).eval().requires_grad_(False)


def assert_same(network: ShallowNetwork, shown: torch.Tensor) -> None:
    with torch.inference_mode():
        made, wanted = GraphPass(network)(shown), network(shown)
    assert len(made) == len(wanted)
    for one, other in zip(made, wanted, strict=True):
        assert one.shape == other.shape and one.dtype == torch.float32
        assert one.permute(0, 2, 3, 1).is_contiguous()
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


@pytest.fixture(scope="module")
def packaged() -> ShallowNetwork:
    return load_network(PACKAGED / "placerec-hybrid.network.safetensors", OUTPUTS)


@pytest.mark.thorough
@pytest.mark.parametrize("count", [1, 3])
def test_the_packaged_network_gives_what_torch_gives(packaged: ShallowNetwork, count: int) -> None:
    assert_same(packaged, images(count, 227))


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("before", [False, True])
def test_the_orders_of_caffenet_and_alexnet(normalize: bool, before: bool) -> None:
    torch.manual_seed(1)
    definition = caffenet_definition("c", normalize=normalize, norm_before_pool=before)
    assert_same(ShallowNetwork(definition, ("conv2", "conv5", "pool1")).eval(), images(2, 227))


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
        assert_same(network, images(2, side)[:, :, :, 1:])


def test_threads_share_a_pass_and_a_frame_has_the_same_values_in_company(packaged: ShallowNetwork) -> None:
    made, shown = GraphPass(packaged), images(6, 227)
    together = made(shown)
    alone = each(lambda index: made(shown[index : index + 1]), range(6), 2)
    for index, outputs in enumerate(alone):
        for one, other in zip(outputs, together, strict=True):
            torch.testing.assert_close(one[0], other[index], atol=1e-5, rtol=1e-5)


def test_what_cannot_be_computed_is_refused(capfd: pytest.CaptureFixture[str]) -> None:
    convolution = Convolution(name="a", channels=8, kernel=3)
    with pytest.raises(InvalidModel, match=r"\[1, 2, 2, 3\]"):
        GraphPass(network_of(convolution, outputs=("a",)))(images(1, 2))
    even = network_of(
        convolution, Normalization(name="n", size=4), Convolution(name="b", channels=1, kernel=1), outputs=("b",)
    )
    with pytest.raises(InvalidModel, match="'small' cannot be computed"):
        GraphPass(even)
    assert capfd.readouterr() == ("", ""), "the errors say it"


def test_bfloat16_comes_near_and_gives_float32(packaged: ShallowNetwork) -> None:
    with torch.inference_mode():
        for made, wanted in zip(TorchPass(packaged, "bfloat16")(images(1, 227)), packaged(images(1, 227)), strict=True):
            assert made.dtype == torch.float32
            cosine = nn.functional.cosine_similarity(made.flatten(), wanted.flatten(), dim=0)
            assert 0.9999 < cosine < 1 and not torch.equal(made, wanted)


@pytest.mark.parametrize("make", [GraphPass, partial(TorchPass, precision="float32")])
def test_the_weights_are_copied(make: Callable[[ShallowNetwork], GraphPass | TorchPass]) -> None:
    network = network_of(Convolution(name="a", channels=8, kernel=3), outputs=("a",))
    made = make(network)
    with torch.inference_mode():
        before = made(images(1, 33))[0].clone()
        for tensor in network.state_dict().values():
            tensor.zero_()
        torch.testing.assert_close(made(images(1, 33))[0], before)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_machine_without_cuda_says_so() -> None:
    network = network_of(Convolution(name="a", channels=8, kernel=3), outputs=("a",))
    with pytest.raises(InvalidModel, match="CUDA"):
        cuda_pass(network, "float32")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_a_cuda_device_gives_what_the_processor_gives_to_many_threads() -> None:
    network = load_network(PACKAGED / "placerec-hybrid.network.safetensors", OUTPUTS)
    shown, on_device = images(24, 227), cuda_pass(network, "float32")

    def compute(index: int) -> tuple[torch.Tensor, ...]:
        with torch.inference_mode():
            return on_device(shown[index : index + 1])

    with torch.inference_mode():
        wanted = network(shown)
    for index, outputs in enumerate(each(compute, range(len(shown)), 8)):
        for made, other in zip(outputs, wanted, strict=True):
            torch.testing.assert_close(made[0], other[index], atol=1e-3, rtol=1e-3)
