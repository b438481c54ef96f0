from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition
from lab.baselines.trunks.vgg import CONVOLUTIONS, forward, load_vgg16, torchvision_indices
from tests.lab.conversion.vgg_writer import blocks, plain_maps, plain_vgg

MEAN = (100.0, 110.0, 120.0)


def shown(height: int = 64, width: int = 96) -> InputDefinition:
    return InputDefinition(height=height, width=width, mean=MEAN)


def tensors(weights: dict[str, Any]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(weight) for name, weight in weights.items()}


def test_the_places_in_torchvision() -> None:
    indices = torchvision_indices()
    assert list(indices) == list(CONVOLUTIONS)
    assert list(indices.values()) == [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]


@pytest.mark.parametrize("rectified", [False, True])
def test_conv5_3_before_and_after_its_rectifier(rectified: bool) -> None:
    picture = blocks(64, 96)
    network = load_vgg16(tensors(plain_vgg(last=-2)), shown(), rectified=rectified)
    (maps,) = forward(network, picture)
    wanted = plain_maps(picture, MEAN, last=-2)
    np.testing.assert_allclose(maps.numpy(), np.maximum(wanted, 0) if rectified else wanted)
    assert wanted.min() < -10


@pytest.mark.thorough
def test_it_is_the_network_of_the_paper() -> None:
    torch.manual_seed(0)
    widths = (4, 5, 6, 7, 8)
    layers: list[nn.Module] = []
    channels = 3
    for width, count in zip(widths, (2, 2, 3, 3, 3), strict=True):
        for _ in range(count):
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        layers.append(nn.MaxPool2d(2))
    features = nn.Sequential(*layers)
    state = features.state_dict()
    named = {
        f"{name}.{kind}": state[f"{index}.{kind}"]
        for name, index in torchvision_indices().items()
        for kind in ("weight", "bias")
    }
    network = load_vgg16(named, shown(), outputs=("conv5_1", "conv5_3"), rectified=True)
    picture = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
    image = torch.from_numpy(picture.astype(np.float32) - np.array(MEAN, np.float32)).permute(2, 0, 1)[None]
    with torch.inference_mode():
        found = forward(network, picture)
        for maps, end in zip(found, (26, 30), strict=True):
            torch.testing.assert_close(maps, features[:end](image)[0])


@pytest.mark.parametrize(
    "spoil",
    [
        lambda weights: weights.pop("conv3_2.weight"),
        lambda weights: weights.pop("conv5_3.bias"),
        lambda weights: weights.update({"conv2_1.weight": np.zeros((3, 4, 3, 3), np.float32)}),
        lambda weights: weights.update({"conv2_1.bias": np.full(3, np.nan, np.float32)}),
        lambda weights: weights.update({"conv2_1.weight": np.zeros(3, np.float32)}),
    ],
)
def test_weights_that_do_not_fit(spoil: Any) -> None:
    weights = plain_vgg()
    spoil(weights)
    with pytest.raises(InvalidModel, match="conv"):
        load_vgg16(tensors(weights), shown(), rectified=True)
