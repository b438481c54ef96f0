"""The student: HybridNet's layout with batch normalization while it learns, folded away after."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from core.networks.network import Convolution, NetworkDefinition, caffenet_definition
from core.networks.torch_network import build_layer

TEACHER_CHANNELS = 512
SCALE = 0.017


def student_definition() -> NetworkDefinition:
    """HybridNet down to conv4, without local response normalization (batch norm took its place)."""
    return caffenet_definition("placerec-hybrid", normalize=False, depth=4, scale=SCALE)


class Student(nn.Module):
    """The backbone with batch norm behind each convolution and two 1x1 heads for the teacher's maps."""

    def __init__(self) -> None:
        super().__init__()
        self.definition = student_definition()
        self.stages = nn.ModuleDict()
        channels = 3
        for layer in self.definition.layers:
            self.stages[layer.name] = build_layer(layer, channels)
            if isinstance(layer, Convolution):
                channels = layer.channels
                self.stages[f"{layer.name}_bn"] = nn.BatchNorm2d(channels)
        self.head_conv3 = nn.Conv2d(384, TEACHER_CHANNELS, 1)
        self.head_conv4 = nn.Conv2d(384, TEACHER_CHANNELS, 1)
        self.mean: Tensor
        self.register_buffer("mean", torch.tensor(self.definition.input.mean).view(1, 3, 1, 1))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")

    def features(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """B x 3 x 227 x 227 BGR in 0–255 to rectified conv3 and conv4, each B x 384 x 13 x 13."""
        x = (pixels - self.mean) * SCALE
        rectified = []
        for name, module in self.stages.items():
            x = module(x)
            if name in ("relu3", "relu4"):
                rectified.append(x)
        return rectified[0], rectified[1]

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """The two features as the teacher would see them, each B x 512 x 13 x 13."""
        conv3, conv4 = self.features(pixels)
        return self.head_conv3(conv3), self.head_conv4(conv4)

    @torch.no_grad()
    def load_folded_weights(self, weights: dict[str, Tensor], pixels: Tensor) -> None:
        """Go on from ``folded_weights``: the same features on ``pixels``, with batch norm to learn through again.

        Each filter gets the length it would be drawn with; its batch norm gets the statistics of what the filter
        gives for ``pixels`` (B x 3 x 227 x 227) and the gain and shift that undo them.  The heads stay as they are.
        """
        x = (pixels - self.mean) * SCALE
        for name, module in self.stages.items():
            if isinstance(module, nn.BatchNorm2d):
                continue
            if not isinstance(module, nn.Conv2d):
                x = module(x)
                continue
            weight, bias = weights[f"{name}.weight"].to(x.device), weights[f"{name}.bias"].to(x.device)
            length = weight.flatten(1).norm(dim=1).clamp_min(1e-12) / math.sqrt(2)
            norm = self.stages[f"{name}_bn"]
            assert isinstance(norm, nn.BatchNorm2d) and norm.running_mean is not None and norm.running_var is not None
            assert module.bias is not None
            module.weight.copy_(weight / length.view(-1, 1, 1, 1))
            module.bias.zero_()
            x = module(x)
            norm.running_mean.copy_(x.mean((0, 2, 3)))
            norm.running_var.copy_(x.var((0, 2, 3)))
            norm.weight.copy_(length * torch.sqrt(norm.running_var + norm.eps))
            norm.bias.copy_(bias + length * norm.running_mean)
            x = x * length.view(1, -1, 1, 1) + bias.view(1, -1, 1, 1)

    @torch.no_grad()
    def folded_weights(self) -> dict[str, Tensor]:
        """``<layer>.weight`` and ``<layer>.bias`` with each batch norm folded into its convolution."""
        weights: dict[str, Tensor] = {}
        for layer in self.definition.convolutions():
            convolution, norm = self.stages[layer.name], self.stages[f"{layer.name}_bn"]
            assert isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d)
            assert norm.running_mean is not None and norm.running_var is not None
            assert convolution.bias is not None
            gain = norm.weight / torch.sqrt(norm.running_var + norm.eps)
            bias = (convolution.bias - norm.running_mean) * gain + norm.bias
            weights[f"{layer.name}.weight"] = (convolution.weight * gain.view(-1, 1, 1, 1)).contiguous()
            weights[f"{layer.name}.bias"] = bias.contiguous()
        return {name: tensor.detach().float().cpu().clone() for name, tensor in weights.items()}
