"""Published checkpoints: a network's layout is built for the weights of a file, and exported to the ONNX format.

The weights are read as plain tensors (``lab.conversion.checkpoints``), which hold no code.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from core.errors import InvalidModel
from core.networks.description import NetworkDescription
from lab.conversion.checkpoints import read_checkpoint, under
from lab.conversion.layouts.heads import CROSS_IMAGE_HEADS, Boq, MixVpr, Pyramid, Salad, gem_and_linear
from lab.conversion.layouts.trunks import PATCH, Dino, Weights, resnet, shape_of, vgg16

OPSET = 17
WRAPPERS = ("state_dict.", "model_state_dict.", "module.")
"""Names in front of all others in some checkpoints."""

VALUES_OF = (31, 40)
"""AnyLoc reads the values of the block of this number, of so many; of fewer blocks, one as deep in proportion."""

Grid = tuple[int, int]


class GemNetwork(nn.Module):
    """CosPlace and EigenPlaces: ResNet or VGG-16, and a generalized mean."""

    def __init__(self, weights: Weights, _grid: Grid) -> None:
        super().__init__()
        residual = "backbone.4.0.conv1.weight" in weights
        trunk = resnet(weights, "backbone.", named=False, groups=4) if residual else vgg16(weights, "backbone.")
        self.backbone, self.aggregation = trunk, gem_and_linear(weights, "aggregation.")

    def forward(self, images: Tensor) -> Tensor:
        return self.aggregation(self.backbone(images))


class MixNetwork(nn.Module):
    """MixVPR: ResNet to its third group."""

    def __init__(self, weights: Weights, _grid: Grid) -> None:
        super().__init__()
        trunk = resnet(weights, "backbone.model.", named=True, groups=3)
        self.backbone = nn.ModuleDict({"model": trunk})
        self.aggregator = MixVpr(weights, "aggregator.")

    def forward(self, images: Tensor) -> Tensor:
        return self.aggregator(self.backbone["model"](images))


class SaladNetwork(nn.Module):
    """SALAD and MegaLoc, which adds a linear layer."""

    def __init__(self, weights: Weights, grid: Grid) -> None:
        super().__init__()
        self.backbone = nn.ModuleDict({"model": Dino(weights, "backbone.model.", grid)})
        self.projected = "aggregator.linear.weight" in weights
        self.aggregator: nn.Module
        if self.projected:
            values, before = shape_of(weights, "aggregator.linear.weight", 2)
            salad = Salad(weights, "aggregator.agg.")
            self.aggregator = nn.ModuleDict({"agg": salad, "linear": nn.Linear(before, values)})
        else:
            self.aggregator = Salad(weights, "aggregator.")

    def forward(self, images: Tensor) -> Tensor:
        dino = self.backbone["model"]
        assert isinstance(dino, Dino)
        tokens = dino.norm(dino(images))
        if not isinstance(self.aggregator, nn.ModuleDict):
            return self.aggregator(dino.maps(tokens), tokens[:, 0])
        found = self.aggregator["agg"](dino.maps(tokens), tokens[:, 0])
        return nn.functional.normalize(self.aggregator["linear"](found), dim=1)


class BoqNetwork(nn.Module):
    """BoQ: DINOv2 without its last normalization, or ResNet to its third group."""

    def __init__(self, weights: Weights, grid: Grid) -> None:
        super().__init__()
        trunk: nn.Module
        if "backbone.dino.pos_embed" in weights:
            name, trunk = "dino", Dino(weights, "backbone.dino.", grid)
        else:
            name, trunk = "net", resnet(weights, "backbone.net.", named=False, groups=3)
        self.backbone = nn.ModuleDict({name: trunk})
        self.aggregator = Boq(weights, "aggregator.")

    def forward(self, images: Tensor) -> Tensor:
        (trunk,) = self.backbone.values()
        found = trunk(images)
        return self.aggregator(trunk.maps(found) if isinstance(trunk, Dino) else found)


class CricaNetwork(nn.Module):
    """CricaVPR: an adapted DINOv2, a pyramid, and an encoder across pictures, of which there is one here."""

    def __init__(self, weights: Weights, grid: Grid) -> None:
        super().__init__()
        if grid != (16, 16):
            raise InvalidModel("CricaVPR takes an input of 224x224 only.")
        self.backbone = Dino(weights, "backbone.", grid)
        hidden, width = shape_of(weights, "encoder.layers.0.linear1.weight", 2)
        layers = [name for name in weights if name.startswith("encoder.layers.") and name.endswith(".norm1.weight")]
        layer = nn.TransformerEncoderLayer(width, CROSS_IMAGE_HEADS, hidden, activation="gelu")
        self.encoder = nn.TransformerEncoder(layer, len(layers), enable_nested_tensor=False)
        self.pyramid = Pyramid()
        self.aggregation = self.pyramid.mean

    def forward(self, images: Tensor) -> Tensor:
        tokens = self.backbone.norm(self.backbone(images))
        parts = self.pyramid(self.backbone.maps(tokens), tokens[:, 0])
        return nn.functional.normalize(self.encoder(parts).flatten(1), dim=1)


class ValueNetwork(nn.Module):
    """AnyLoc: the values of the patches within a block of DINOv2, 1 x N x D."""

    def __init__(self, weights: Weights, grid: Grid) -> None:
        super().__init__()
        self.dino = Dino({f"dino.{name}": weights[name] for name in weights}, "dino.", grid)
        number, of = VALUES_OF
        self.depth = number * len(self.dino.blocks) // of

    def forward(self, images: Tensor) -> Tensor:
        x = self.dino.embed(images)
        for block in list(self.dino.blocks)[: self.depth]:
            x = block(x)
        last = self.dino.blocks[self.depth]
        values: Tensor = last.attn.qkv(last.norm1(x))  # type: ignore[operator, union-attr]
        return values[:, 1:, -self.dino.width :]


LAYOUTS: dict[str, Callable[[Weights, Grid], nn.Module]] = {
    "cosplace": GemNetwork,
    "eigenplaces": GemNetwork,
    "mixvpr": MixNetwork,
    "salad": SaladNetwork,
    "boq": BoqNetwork,
    "cricavpr": CricaNetwork,
    "megaloc": SaladNetwork,
    "anyloc": ValueNetwork,
}
"""The network of each preset (``lab.conversion.published``)."""


def build(preset: str, checkpoint: Mapping[str, Tensor], description: NetworkDescription) -> nn.Module:
    """The network of a preset with the weights of its checkpoint.

    Raises:
        InvalidModel: the checkpoint is not one of this layout; the text names a tensor that is missing, left over or of
            another shape.
    """
    weights: Mapping[str, Tensor] = checkpoint
    while wrapper := next((one for one in WRAPPERS if any(name.startswith(one) for name in weights)), None):
        weights = under(weights, wrapper)
    weights = {name: weights[name] for name in weights}
    shown = description.input
    try:
        network = LAYOUTS[preset](weights, (shown.height // PATCH, shown.width // PATCH))
        if preset == "anyloc":
            weights = {f"dino.{name}": tensor for name, tensor in weights.items()}
        missing, unused = network.load_state_dict(weights, strict=False)
    except (RuntimeError, ValueError) as error:  # a tensor of another shape
        raise InvalidModel(f"The checkpoint is not one of {preset}: {' '.join(str(error).split())[:300]}") from error
    missing = [name for name in missing if not name.endswith("num_batches_tracked") and not _doubled(name)]
    unused = [name for name in unused if not name.endswith("num_batches_tracked")]
    if missing or unused:
        what = f"lacks {missing[0]}" if missing else f"has {unused[0][:80]}, which the layout has not"
        raise InvalidModel(f"The checkpoint is not one of {preset}: it {what}.")
    for name, tensor in network.state_dict().items():
        if not torch.isfinite(tensor).all():
            raise InvalidModel(f"The checkpoint's {name} holds values that are not finite.")
    return network.eval().requires_grad_(False)


def _doubled(name: str) -> bool:
    """Whether a part of CricaVPR has a second name, under which the layout calls it."""
    return name.startswith("pyramid.mean.")


def export_checkpoint(path: Path, preset: str, description: NetworkDescription, target: Path) -> None:
    """Read a published checkpoint, and export its network to a file in the ONNX format.

    Raises:
        InvalidModel: the file cannot be read, or is no checkpoint of the preset's network.
    """
    network = build(preset, read_checkpoint(path), description)
    shown = description.input
    image = torch.zeros(1, 3, shown.height, shown.width)
    fast = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)  # its fused operators have no counterpart in the format
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.onnx.export(network, (image,), target, dynamo=False, opset_version=OPSET, output_names=["output"])
    except (RuntimeError, ValueError, torch.onnx.errors.OnnxExporterError) as error:
        text = " ".join(str(error).split())[:300]
        raise InvalidModel(f"{path.name} does not make a network of {preset}: {text}") from error
    finally:
        torch.backends.mha.set_fastpath_enabled(fast)
