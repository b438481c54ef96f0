"""A faster forward pass of a shallow network: each convolution and its rectifier are one step.

torch's own pass brings the weights into the processor's layout at every call, and reads each map once more to rectify
it.  Here the weights are brought into that layout once, oneDNN rectifies within the convolution, and max-pooling reads
channels-last maps without recording where each maximum came from.  Kernels of 3 x 3 and 5 x 5 take half the
multiplications (``winograd.py``), which round differently from torch's own sums.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from core.errors import InvalidModel
from core.kernels.pooling import max_pool
from core.networks.convolution import LAST, FusedConvolution
from core.networks.network import Convolution, Pooling, Relu, ShallowNetwork
from core.networks.winograd import fast_convolution

Precision = Literal["float32", "bfloat16"]
Device = Literal["cpu", "cuda"]
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}

AGREEMENT = 1e-4
"""Largest difference of a fused float32 pass from torch's own, as a share of the largest activation."""


class FusedPass:
    """A :class:`ShallowNetwork` as a chain of fused steps; it is called like the network.

    Args:
        network: its weights are copied, so that later changes to it have no effect.
        precision: of weights and activations; the outputs are always float32.

    Raises:
        RuntimeError: this build of torch or this processor lacks the fused convolution.
    """

    def __init__(self, network: ShallowNetwork, precision: Precision = "float32") -> None:
        self.outputs, self.precision = network.outputs, precision
        self._dtype = DTYPES[precision]
        self._steps: list[tuple[str, Callable[[Tensor], Tensor]]] = []
        layers = network.definition.layers
        for layer, following in zip(layers, [*layers[1:], None], strict=True):
            module = network.stages[layer.name]
            if isinstance(layer, Convolution):
                rectified = isinstance(following, Relu) and following.negative_slope == 0
                fast = fast_convolution(module, rectified) if precision == "float32" else None
                self._steps.append((layer.name, fast or FusedConvolution.of(module, rectified, self._dtype)))
                if isinstance(following, Relu) and not rectified:
                    self._steps.append((layer.name, network.stages[following.name]))
            elif isinstance(layer, Pooling):
                plain = layer.method == "max" and layer.pad == 0 and precision == "float32"
                self._steps.append((layer.name, MaxPooling(layer) if plain else module))
            elif not isinstance(layer, Relu):
                self._steps.append((layer.name, module))

    def __call__(self, images: Tensor) -> tuple[Tensor, ...]:
        """B x 3 x H x W float32 to one B x K x X x Y float32 tensor for each output, channels last in memory."""
        found: dict[str, Tensor] = {}
        x = images.to(self._dtype)
        for name, step in self._steps:
            x = step(x)
            if name in self.outputs:
                found[name] = x
        return tuple(found[name].float().contiguous(memory_format=LAST) for name in self.outputs)


class MaxPooling:
    """Max-pooling without padding of float32 maps that are channels last in memory."""

    def __init__(self, layer: Pooling) -> None:
        self._kernel, self._stride, self._ceil = layer.kernel, layer.stride, layer.ceil

    def _size(self, cells: int) -> int:
        """The rows or columns of the output; every window starts within the map."""
        over = cells - self._kernel
        size = 1 + (-(-over // self._stride) if self._ceil else over // self._stride)
        return size - 1 if (size - 1) * self._stride >= cells else size

    def __call__(self, x: Tensor) -> Tensor:
        maps = x.permute(0, 2, 3, 1).contiguous().numpy()
        count, height, width, channels = maps.shape
        pooled = np.empty((count, self._size(height), self._size(width), channels), np.float32)
        max_pool(maps, self._kernel, self._stride, pooled)
        return torch.from_numpy(pooled).permute(0, 3, 1, 2)


def fused_pass(network: ShallowNetwork, precision: Precision = "float32") -> FusedPass | None:
    """Make the fused pass of a network and try it once; None if this machine lacks it, or if it gives other values.

    Args:
        precision: bfloat16 is only checked to run; its user must compare the descriptors with those of float32.
    """
    shown = network.input
    image = torch.rand(1, 3, shown.height, shown.width, generator=torch.Generator().manual_seed(0)) - 0.5
    image = image.contiguous(memory_format=LAST)
    try:
        with torch.inference_mode():
            made = FusedPass(network, precision)
            pairs = list(zip(made(image), network(image), strict=True))
    except (RuntimeError, AttributeError):  # the operator is not in this build, or refuses the type
        return None
    near = all(float((a - b).abs().max()) <= AGREEMENT * float(b.abs().max()) for a, b in pairs)
    return made if near or precision != "float32" else None


def has_bfloat16() -> bool:
    """Whether torch lets the processor multiply bfloat16, twice as fast as float32; elsewhere it is emulated.

    ``ATEN_CPU_CAPABILITY`` can keep torch to a part of what the processor has.
    """
    supported = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return supported is not None and bool(supported()) and torch.backends.cpu.get_cpu_capability() == "AVX512"


class CudaPass:
    """A network on the first CUDA device, in full float32; it is called like the network, with outputs on the CPU.

    Raises:
        InvalidModel: torch finds no CUDA device.
    """

    def __init__(self, network: ShallowNetwork) -> None:
        if not torch.cuda.is_available():
            raise InvalidModel("torch finds no CUDA device on this machine; use the device cpu.")
        # By default torch allows cuDNN a mantissa of ten bits, which changes regions.
        torch.backends.cudnn.allow_tf32 = False
        copied = copy.deepcopy(network)
        self._network = copied.to("cuda", memory_format=LAST)  # type: ignore[call-overload]

    def __call__(self, images: Tensor) -> tuple[Tensor, ...]:
        """B x 3 x H x W float32 to one B x K x X x Y float32 tensor for each output."""
        return tuple(output.cpu() for output in self._network(images.to("cuda")))
