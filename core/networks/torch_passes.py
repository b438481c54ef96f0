"""The forward passes that torch computes: on a GPU, and in a lower precision on the processor."""

from __future__ import annotations

import torch
from torch import Tensor

from core.errors import InvalidModel
from core.networks.backbone import Array, Device, Pass, Precision
from core.networks.gathering import GatheredPass
from core.networks.network import ShallowNetwork
from core.networks.torch_network import TorchNetwork, as_array, as_tensor, follow_threads

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}

LANES = 2
"""Batches that are on a GPU at the same time: one is computed while the other is brought there or back."""

MOST_IMAGES = 64
"""Images of one batch on a GPU."""


def torch_pass(network: ShallowNetwork, precision: Precision, device: Device) -> Pass:
    """The pass of a copy of a network in a precision and on a device.

    Raises:
        InvalidModel: torch finds no CUDA device.
    """
    return cuda_pass(network, precision) if device == "cuda" else TorchPass(network, precision)


class TorchPass:
    """A copy of a network in torch, on the processor and in a precision."""

    def __init__(self, network: ShallowNetwork, precision: Precision) -> None:
        self._dtype = DTYPES[precision]
        self._network = _copied(network, torch.device("cpu"), self._dtype)

    def __call__(self, images: Array) -> tuple[Array, ...]:
        """float32 [B, H, W, 3] to one float32 [B, X, Y, K] for each output."""
        follow_threads()
        with torch.inference_mode():
            return tuple(as_array(output) for output in self._network(as_tensor(images).to(self._dtype)))


def cuda_pass(network: ShallowNetwork, precision: Precision) -> GatheredPass:
    """A copy of a network on a GPU; threads that call it at the same time share batches.

    Raises:
        InvalidModel: torch finds no CUDA device.
    """
    if not torch.cuda.is_available():
        raise InvalidModel("torch finds no CUDA device on this machine; use the device cpu.")
    # By default torch allows cuDNN a mantissa of ten bits, which changes regions.
    torch.backends.cudnn.allow_tf32 = False
    copied = _copied(network, torch.device("cuda"), DTYPES[precision])
    return GatheredPass([_CudaLane(copied, DTYPES[precision]) for _ in range(LANES)], MOST_IMAGES)


class _CudaLane:
    """Computes one batch after the other in a stream of its own, by way of memory that the GPU reads and writes itself.

    Args:
        network: on the GPU.
        dtype: of its weights.
    """

    def __init__(self, network: TorchNetwork, dtype: torch.dtype) -> None:
        self._network, self._dtype = network, dtype
        self._stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]

    def __call__(self, images: Array) -> tuple[Array, ...]:
        """float32 [B, H, W, 3] to one float32 [B, X, Y, K] for each output, both on the processor."""
        with torch.inference_mode(), torch.cuda.stream(self._stream):
            there = as_tensor(images).pin_memory().to("cuda", non_blocking=True)
            outputs: list[Tensor] = [output.to(torch.float32) for output in self._network(there.to(self._dtype))]
            here = [torch.empty_like(output, device="cpu", pin_memory=True) for output in outputs]
            for back, output in zip(here, outputs, strict=True):
                back.copy_(output, non_blocking=True)
            self._stream.synchronize()
            return tuple(as_array(output) for output in here)


def _copied(network: ShallowNetwork, device: torch.device, dtype: torch.dtype) -> TorchNetwork:
    made = TorchNetwork.of(network)
    return made.to(device, dtype, memory_format=torch.channels_last)  # type: ignore[call-overload]
