"""The fused forward pass against torch's own, layer by layer and with odd layers in between."""

from __future__ import annotations

import pytest
import torch
from torch import nn

import core.networks.convolution
from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition
from core.method.catalogue import PACKAGED
from core.networks.forward import CudaPass, FusedPass, fused_pass
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

OUTPUTS = ("pool2", "conv3", "conv4")


def images(count: int, side: int, seed: int = 0) -> torch.Tensor:
    made = torch.randn(count, 3, side, side, generator=torch.Generator().manual_seed(seed))
    return made.contiguous(memory_format=torch.channels_last)


def network_of(*layers: Layer, outputs: tuple[str, ...]) -> ShallowNetwork:
    torch.manual_seed(0)
    shown = InputDefinition(height=33, width=33, mean=(0.0, 0.0, 0.0))
    definition = NetworkDefinition(name="small", input=shown, layers=layers)
    return ShallowNetwork(definition, outputs).eval().requires_grad_(False)


def assert_same(made: tuple[torch.Tensor, ...], wanted: tuple[torch.Tensor, ...]) -> None:
    assert len(made) == len(wanted)
    for one, other in zip(made, wanted, strict=True):
        assert one.shape == other.shape and one.dtype == torch.float32
        assert one.permute(0, 2, 3, 1).is_contiguous()
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("count", [1, 3])
def test_the_packaged_network_gives_what_torch_gives(count: int) -> None:
    network = load_network(PACKAGED / "placerec-hybrid.network.safetensors", OUTPUTS)
    made = fused_pass(network)
    assert made is not None, "this machine has no fused convolutions: encoding is slower, not wrong"
    with torch.inference_mode():
        assert_same(made(images(count, 227)), network(images(count, 227)))


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("before", [False, True])
def test_the_orders_of_caffenet_and_alexnet(normalize: bool, before: bool) -> None:
    torch.manual_seed(1)
    definition = caffenet_definition("c", normalize=normalize, norm_before_pool=before)
    network = ShallowNetwork(definition, ("conv2", "conv5", "pool1")).eval().requires_grad_(False)
    with torch.inference_mode():
        assert_same(FusedPass(network)(images(2, 227)), network(images(2, 227)))


def test_leaky_rectifiers_averages_and_a_last_layer_without_rectifier() -> None:
    network = network_of(
        Convolution(name="a", channels=8, kernel=3, pad=1),
        Relu(name="leaky", negative_slope=0.1),
        Pooling(name="mean", method="average", kernel=2, stride=2),
        Normalization(name="norm"),
        Pooling(name="padded", kernel=3, stride=2, pad=1),
        Convolution(name="b", channels=4, kernel=1),
        outputs=("a", "mean", "padded", "b"),
    )
    with torch.inference_mode():
        assert_same(FusedPass(network)(images(2, 33)), network(images(2, 33)))


def test_bfloat16_comes_near_and_gives_float32() -> None:
    network = load_network(PACKAGED / "placerec-hybrid.network.safetensors", OUTPUTS)
    lower = fused_pass(network, "bfloat16")
    if lower is None:
        pytest.skip("this build of torch has no convolutions in bfloat16")
    with torch.inference_mode():
        for made, wanted in zip(lower(images(1, 227)), network(images(1, 227)), strict=True):
            assert made.dtype == torch.float32
            cosine = nn.functional.cosine_similarity(made.flatten(), wanted.flatten(), dim=0)
            assert 0.9999 < cosine < 1 and not torch.equal(made, wanted)


def test_other_values_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    network = network_of(Convolution(name="a", channels=8, kernel=3), Relu(name="r"), outputs=("a",))
    assert fused_pass(network) is not None
    run = core.networks.convolution.FusedConvolution.__call__
    monkeypatch.setattr(core.networks.convolution.FusedConvolution, "__call__", lambda self, x: run(self, x) * 1.01)
    assert fused_pass(network) is None


def test_without_the_operator_there_is_no_fused_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(self: object, x: torch.Tensor) -> torch.Tensor:
        raise AttributeError("no such operator")

    monkeypatch.setattr(core.networks.convolution.FusedConvolution, "__call__", missing)
    network = network_of(Convolution(name="a", channels=8, kernel=3), outputs=("a",))
    assert fused_pass(network) is None and fused_pass(network, "bfloat16") is None


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_machine_without_cuda_says_so() -> None:
    network = network_of(Convolution(name="a", channels=8, kernel=3), outputs=("a",))
    with pytest.raises(InvalidModel, match="CUDA"):
        CudaPass(network)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
def test_a_cuda_device_gives_what_the_processor_gives() -> None:
    network = load_network(PACKAGED / "placerec-hybrid.network.safetensors", OUTPUTS)
    with torch.inference_mode():
        for made, wanted in zip(CudaPass(network)(images(2, 227)), network(images(2, 227)), strict=True):
            torch.testing.assert_close(made, wanted, atol=1e-3, rtol=1e-3)


def test_the_weights_are_copied() -> None:
    network = network_of(Convolution(name="a", channels=8, kernel=3), outputs=("a",))
    made = FusedPass(network)
    with torch.inference_mode():
        before = made(images(1, 33))[0].clone()
        for tensor in network.state_dict().values():
            tensor.zero_()
        torch.testing.assert_close(made(images(1, 33))[0], before)
