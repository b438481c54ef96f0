"""Convolutions with fewer multiplications against the direct sum in double precision."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from torch import nn

from core.networks.convolution import FusedConvolution
from core.networks.winograd import SQUARE_POINTS, STRIP_POINTS, SquareTiles, Strips, fast_convolution, transforms

LAST = torch.channels_last


def layer(kernel: int, channels: tuple[int, int], groups: int = 1, pad: int | None = None, **more: object) -> nn.Conv2d:
    torch.manual_seed(kernel)
    padding = kernel // 2 if pad is None else pad
    made: nn.Conv2d = nn.Conv2d(*channels, kernel, padding=padding, groups=groups, **more)  # type: ignore[arg-type]
    return made.requires_grad_(False).to(memory_format=LAST)  # type: ignore[call-overload]


def maps(count: int, channels: int, height: int, width: int) -> torch.Tensor:
    made = torch.rand(count, channels, height, width, generator=torch.Generator().manual_seed(height))
    return made.contiguous(memory_format=LAST)


@pytest.mark.parametrize(("outputs", "taps", "points"), [(2, 3, SQUARE_POINTS), (3, 5, STRIP_POINTS)])
def test_the_transforms_are_exact(outputs: int, taps: int, points: tuple[Fraction, ...]) -> None:
    at, g, bt = transforms(outputs, taps, points)
    random = np.random.default_rng(0)
    values, kernel = random.standard_normal(outputs + taps - 1), random.standard_normal(taps)
    np.testing.assert_allclose(at @ ((g @ kernel) * (bt @ values)), np.correlate(values, kernel, "valid"), rtol=1e-12)


def test_points_must_be_so_many_and_different() -> None:
    for points in ((Fraction(0), Fraction(1)), (Fraction(0), Fraction(1), Fraction(1))):
        with pytest.raises(ValueError, match="3 different points"):
            transforms(2, 3, points)


@pytest.mark.parametrize("rectified", [False, True])
@pytest.mark.parametrize(("height", "width"), [(13, 13), (12, 17), (27, 9)])
@pytest.mark.parametrize(
    ("module", "kind"),
    [
        (layer(3, (384, 384)), SquareTiles),
        (layer(3, (512, 640), groups=2, pad=0), SquareTiles),
        (layer(3, (400, 352), pad=2, bias=False), SquareTiles),
        (layer(5, (96, 256), groups=2), Strips),
        (layer(5, (72, 80), pad=0, bias=False), Strips),
        (layer(5, (64, 64), pad=1), Strips),
    ],
)
def test_values_are_those_of_the_direct_sum(
    module: nn.Conv2d, kind: type, height: int, width: int, rectified: bool
) -> None:
    made = fast_convolution(module, rectified)
    assert made is not None and isinstance(made, kind)
    x = maps(2, module.in_channels, height, width)
    with torch.inference_mode():
        bias = None if module.bias is None else module.bias.double()
        wanted = nn.functional.conv2d(
            x.double(), module.weight.double(), bias, padding=module.padding, groups=module.groups
        )
        wanted = wanted.relu() if rectified else wanted
        found = made(x)
        assert found.shape == wanted.shape and found.permute(0, 2, 3, 1).is_contiguous()
        assert float((found - wanted).abs().max() / wanted.abs().max()) < 5e-6
        for index in range(2):  # alone each map has the same values
            torch.testing.assert_close(made(x[index : index + 1]), found[index : index + 1], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "module",
    [
        layer(3, (384, 384), stride=2),
        layer(3, (384, 384), dilation=2),
        layer(3, (384, 384), padding_mode="reflect"),
        layer(3, (384, 384), groups=2),
        layer(5, (48, 16)),
        layer(7, (384, 384)),
        layer(1, (384, 384)),
    ],
    ids=str,
)
def test_others_are_left_to_the_direct_sum(module: nn.Conv2d) -> None:
    assert fast_convolution(module, True) is None


@pytest.mark.parametrize(("module", "width"), [(layer(3, (384, 384)), 1), (layer(5, (96, 256), groups=2), 1)])
def test_a_map_that_is_mostly_edge_is_left_to_the_direct_sum(
    module: nn.Conv2d, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, x = fast_convolution(module, True), maps(1, module.in_channels, 9, width)
    assert made is not None
    asked: list[torch.Tensor] = []
    run = FusedConvolution.__call__

    def watched(self: FusedConvolution, x: torch.Tensor) -> torch.Tensor:
        asked.append(x)
        return run(self, x)

    monkeypatch.setattr(FusedConvolution, "__call__", watched)
    with torch.inference_mode():
        torch.testing.assert_close(made(x), module(x).relu(), atol=1e-5, rtol=1e-5)
    assert len(asked) == 1 and asked[0] is x
