"""Export a small network to the ONNX format, as one exports one's own.

    python examples/make_network.py small.onnx small-maps.onnx

It writes a network that gives a descriptor of 64 values, and one that gives maps of 32 features.  Their weights are
random: they show the way, and recognize little.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import torch
from torch import nn


def maps() -> nn.Sequential:
    """Images, 1 x 3 x H x W, to maps, 1 x 32 x H/8 x W/8."""
    torch.manual_seed(0)
    channels, layers = 3, []
    for wider in (8, 16, 32):
        layers += [nn.Conv2d(channels, wider, 3, stride=2, padding=1), nn.ReLU()]
        channels = wider
    return nn.Sequential(*layers)


def descriptor() -> nn.Sequential:
    """Images, 1 x 3 x H x W, to descriptors, 1 x 64."""
    return nn.Sequential(maps(), nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(32 * 16, 64))


def export(network: nn.Module, file: Path) -> None:
    """Write a network that takes images of 96 x 96 pixels."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the older exporter, which needs no further package
        torch.onnx.export(network.eval(), (torch.zeros(1, 3, 96, 96),), file, dynamo=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("descriptor", type=Path)
    parser.add_argument("maps", type=Path)
    arguments = parser.parse_args()
    export(descriptor(), arguments.descriptor)
    export(maps(), arguments.maps)


if __name__ == "__main__":
    main()
