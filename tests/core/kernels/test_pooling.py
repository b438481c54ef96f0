"""Compiled max-pooling gives what torch gives, edges and all."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from core.networks.forward import MaxPooling
from core.networks.network import Pooling


@pytest.mark.parametrize(("kernel", "stride"), [(3, 2), (2, 2), (3, 3), (2, 3), (5, 1)])
@pytest.mark.parametrize("side", [7, 8, 12])
@pytest.mark.parametrize("ceil", [False, True])
def test_pooling_is_torchs_own(kernel: int, stride: int, side: int, ceil: bool) -> None:
    x = torch.randn(2, 5, side, side + 1, generator=torch.Generator().manual_seed(side))
    made = MaxPooling(Pooling(name="p", kernel=kernel, stride=stride, ceil=ceil))(x)
    torch.testing.assert_close(made, nn.functional.max_pool2d(x, kernel, stride, ceil_mode=ceil), atol=0, rtol=0)
