"""ResNet-50 up to conv4_x, held to the same network put together from torch's own layers."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from core.errors import InvalidModel
from lab.baselines.trunks.resnet import ResNet50


class Bottleneck(nn.Module):
    """As torchvision builds it: the stride is the 3 x 3 convolution's."""

    def __init__(self, channels: int, narrow: int, wide: int, stride: int, first: bool) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(channels, narrow, 1, bias=False), nn.BatchNorm2d(narrow)
        self.conv2, self.bn2 = nn.Conv2d(narrow, narrow, 3, stride, 1, bias=False), nn.BatchNorm2d(narrow)
        self.conv3, self.bn3 = nn.Conv2d(narrow, wide, 1, bias=False), nn.BatchNorm2d(wide)
        self.downsample: nn.Module | None = None
        if first:
            self.downsample = nn.Sequential(nn.Conv2d(channels, wide, 1, stride, bias=False), nn.BatchNorm2d(wide))

    def forward(self, x: Tensor) -> Tensor:
        found = self.bn1(self.conv1(x)).relu()
        found = self.bn2(self.conv2(found)).relu()
        found = self.bn3(self.conv3(found))
        return torch.relu(found + (x if self.downsample is None else self.downsample(x)))


def small_resnet(seed: int = 0) -> nn.Sequential:
    """Four to nine channels where the published network has 64 to 1024; every normalization does something."""
    torch.manual_seed(seed)
    groups: list[nn.Module] = []
    channels = 4
    for narrow, wide, count, stride in ((2, 5, 3, 1), (3, 7, 4, 2), (4, 9, 6, 2)):
        blocks = []
        for index in range(count):
            blocks.append(Bottleneck(channels, narrow, wide, 1 if index else stride, first=not index))
            channels = wide
        groups.append(nn.Sequential(*blocks))
    first = [nn.Conv2d(3, 4, 7, 2, 3, bias=False), nn.BatchNorm2d(4), nn.ReLU(), nn.MaxPool2d(3, 2, 1)]
    network = nn.Sequential(*first, *groups)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.uniform_(module.bias, -0.2, 0.6)
            nn.init.uniform_(module.running_mean, -0.3, 0.3)  # type: ignore[arg-type]
            nn.init.uniform_(module.running_var, 0.5, 2)  # type: ignore[arg-type]
    return network.eval()


@pytest.mark.parametrize("size", [(64, 96), (75, 53)])
def test_it_is_the_network_of_the_paper(size: tuple[int, int]) -> None:
    theirs = small_resnet()
    ours = ResNet50(theirs.state_dict())
    images = torch.rand(2, 3, *size)
    with torch.inference_mode():
        wanted = theirs(images)
        torch.testing.assert_close(ours(images), wanted, atol=1e-5, rtol=1e-4)
    assert ours.channels == 9 == wanted.shape[1] and wanted.max() > 0.1


@pytest.mark.parametrize(
    "spoil",
    [
        lambda weights: weights.pop("0.weight"),
        lambda weights: weights.pop("6.5.bn3.running_var"),
        lambda weights: weights.pop("5.0.downsample.0.weight"),
        lambda weights: weights.update({"4.1.conv1.weight": torch.zeros(2, 6, 1, 1)}),
        lambda weights: weights.update({"4.1.conv3.weight": torch.zeros(6, 2, 1, 1), **normalization("4.1.bn3", 6)}),
        lambda weights: weights.update({"6.0.bn2.running_var": torch.full((4,), -1.0)}),
        lambda weights: weights.update({"6.0.bn2.bias": torch.full((4,), torch.inf)}),
    ],
)
def test_weights_that_do_not_fit(spoil: Any) -> None:
    weights = dict(small_resnet().state_dict())
    spoil(weights)
    with pytest.raises(InvalidModel):
        ResNet50(weights)


def normalization(name: str, count: int) -> dict[str, Tensor]:
    return {f"{name}.{part}": torch.ones(count) for part in ("weight", "bias", "running_mean", "running_var")}
