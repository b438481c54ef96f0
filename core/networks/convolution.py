"""A convolution and its rectifier in one oneDNN primitive, its weights in the order in which its kernel reads them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

LAST = torch.channels_last


class FusedConvolution:
    """A convolution whose weights never change.

    Args:
        weight: O x C / groups x height x width; copied, as the bias is.
        bias: of O values; None: none.
        padding, stride, dilation: down and across.
        rectified: whether what comes out is at least 0.
        dtype: of weights, inputs and outputs.

    Raises:
        RuntimeError, AttributeError: when called; this build of torch or this processor lacks the operator.
    """

    def __init__(
        self,
        weight: Tensor,
        bias: Tensor | None,
        *,
        padding: Sequence[int] = (0, 0),
        stride: Sequence[int] = (1, 1),
        dilation: Sequence[int] = (1, 1),
        groups: int = 1,
        rectified: bool = False,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self._weight = weight.detach().to(dtype, copy=True).contiguous(memory_format=LAST)
        self._bias = None if bias is None else bias.detach().to(dtype, copy=True)
        self._shape = (list(padding), list(stride), list(dilation), groups)
        self._then = "relu" if rectified else "none"
        self._ordered = False

    @classmethod
    def of(cls, module: nn.Module, rectified: bool, dtype: torch.dtype = torch.float32) -> FusedConvolution:
        """That of a layer of a network, zeros around its input."""
        assert isinstance(module, nn.Conv2d) and not isinstance(module.padding, str)
        return cls(
            module.weight,
            module.bias,
            padding=module.padding,
            stride=module.stride,
            dilation=module.dilation,
            groups=module.groups,
            rectified=rectified,
            dtype=dtype,
        )

    def __call__(self, x: Tensor) -> Tensor:
        """B x C x H x W to B x O x X x Y, channels last in memory."""
        if not self._ordered:  # now that the input's size is known; the order is the same for any number of frames
            self._weight = torch.ops.mkldnn._reorder_convolution_weight(self._weight, *self._shape, list(x.shape))
            self._ordered = True
        run: Any = torch.ops.mkldnn._convolution_pointwise
        made: Tensor = run(x, self._weight, self._bias, *self._shape, self._then, [], "")
        return made
