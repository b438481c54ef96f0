"""Small networks of the published layouts, with random weights and the published names of their parts.

They are written after the papers, apart from ``lab.conversion.layouts``, and stand for the authors' networks, whose
weights are not at hand: their state is saved as the authors save theirs, and what they compute is what the imported
network must give.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, gelu, interpolate, normalize

SIZES = {
    "cosplace": 64,
    "eigenplaces": 64,
    "mixvpr": 320,
    "salad": 112,
    "boq": 112,
    "cricavpr": 224,
    "megaloc": 112,
    "anyloc": 126,
}
"""The side of each network's input, in pixels: small where the layout allows it."""

WIDTH = 64


class Bottleneck(nn.Module):
    def __init__(self, before: int, inner: int, after: int, stride: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(before, inner, 1, bias=False), nn.BatchNorm2d(inner)
        self.conv2, self.bn2 = nn.Conv2d(inner, inner, 3, stride, 1, bias=False), nn.BatchNorm2d(inner)
        self.conv3, self.bn3 = nn.Conv2d(inner, after, 1, bias=False), nn.BatchNorm2d(after)
        self.relu = nn.ReLU()
        self.downsample = None
        if stride > 1 or before != after:
            self.downsample = nn.Sequential(nn.Conv2d(before, after, 1, stride, bias=False), nn.BatchNorm2d(after))

    def forward(self, x: Tensor) -> Tensor:
        y = self.relu(self.bn1(self.conv1(x)))
        y = self.bn3(self.conv3(self.relu(self.bn2(self.conv2(y)))))
        return self.relu(y + (self.downsample(x) if self.downsample else x))


class Basic(nn.Module):
    def __init__(self, before: int, after: int, stride: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after)
        self.conv2, self.bn2 = nn.Conv2d(after, after, 3, 1, 1, bias=False), nn.BatchNorm2d(after)
        self.relu = nn.ReLU()
        self.downsample = None
        if stride > 1 or before != after:
            self.downsample = nn.Sequential(nn.Conv2d(before, after, 1, stride, bias=False), nn.BatchNorm2d(after))

    def forward(self, x: Tensor) -> Tensor:
        y = self.bn2(self.conv2(self.relu(self.bn1(self.conv1(x)))))
        return self.relu(y + (self.downsample(x) if self.downsample else x))


def stem(channels: int) -> list[tuple[str, nn.Module]]:
    return [
        ("conv1", nn.Conv2d(3, channels, 7, 2, 3, bias=False)),
        ("bn1", nn.BatchNorm2d(channels)),
        ("relu", nn.ReLU()),
        ("maxpool", nn.MaxPool2d(3, 2, 1)),
    ]


def resnet50(groups: int) -> list[tuple[str, nn.Module]]:
    """A ResNet of bottlenecks: 8, 16, 32 and 64 channels."""
    parts, before = stem(8), 8
    for group in range(groups):
        after = 8 * 2**group
        first = Bottleneck(before, 4, after, 1 if group == 0 else 2)
        parts.append((f"layer{group + 1}", nn.Sequential(first, Bottleneck(after, 4, after, 1))))
        before = after
    return parts


class L2(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return x / x.norm(dim=1, keepdim=True).clamp(min=1e-12)


class GeM(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.ones(1) * 3)

    def forward(self, x: Tensor) -> Tensor:
        return avg_pool2d(x.clamp(min=1e-6).pow(self.p), x.shape[-2:]).pow(1 / self.p)


class Flat(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return x[:, :, 0, 0]


class CosPlace(nn.Module):
    def __init__(self, vgg: bool = False) -> None:
        super().__init__()
        if vgg:
            parts: list[nn.Module] = []
            before = 3
            for block, count in enumerate((2, 2, 3, 3, 3)):
                for _ in range(count):
                    parts += [nn.Conv2d(before, 4 + block, 3, padding=1), nn.ReLU()]
                    before = 4 + block
                parts.append(nn.MaxPool2d(2, 2))
            self.backbone = nn.Sequential(*parts[:-2])
            channels = before
        else:
            groups, channels = [], 8
            for group in range(4):
                after = 8 * 2**group
                groups.append(nn.Sequential(Basic(channels, after, 1 if group == 0 else 2), Basic(after, after, 1)))
                channels = after
            self.backbone = nn.Sequential(*(part for _, part in stem(8)), *groups)
        self.aggregation = nn.Sequential(L2(), GeM(), Flat(), nn.Linear(channels, 16), L2())

    def forward(self, x: Tensor) -> Tensor:
        return self.aggregation(self.backbone(x))


class EigenPlaces(CosPlace):
    def __init__(self) -> None:
        super().__init__(vgg=True)


class Named(nn.Module):
    """A part under a name."""

    def __init__(self, name: str, part: nn.Module) -> None:
        super().__init__()
        self.name = name
        self.add_module(name, part)

    def forward(self, x: Tensor) -> Tensor:
        return getattr(self, self.name)(x)


class MixLayer(nn.Module):
    def __init__(self, cells: int) -> None:
        super().__init__()
        self.mix = nn.Sequential(nn.LayerNorm(cells), nn.Linear(cells, cells), nn.ReLU(), nn.Linear(cells, cells))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.mix(x)


class MixHead(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.mix = nn.Sequential(MixLayer(400), MixLayer(400))
        self.channel_proj, self.row_proj = nn.Linear(32, 12), nn.Linear(400, 4, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        x = self.mix(x.flatten(2))
        x = torch.einsum("bkn,ck->bcn", x, self.channel_proj.weight) + self.channel_proj.bias[:, None]
        return normalize(torch.einsum("bcn,rn->bcr", x, self.row_proj.weight).flatten(1))


class MixVPR(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.backbone = Named("model", nn.Sequential(OrderedDict(resnet50(3))))
        self.aggregator = MixHead()

    def forward(self, x: Tensor) -> Tensor:
        return self.aggregator(self.backbone(x))


class ViTAttention(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.qkv, self.proj = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)

    def forward(self, x: Tensor) -> Tensor:  # one head of 64 values
        query, key, value = self.qkv(x).split(WIDTH, dim=-1)
        return self.proj((query @ key.transpose(1, 2) / math.sqrt(WIDTH)).softmax(-1) @ value)


class Gamma(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.rand(WIDTH))


class ViTMlp(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(WIDTH, 2 * WIDTH), nn.Linear(2 * WIDTH, WIDTH)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(gelu(self.fc1(x)))


class GatedMlp(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.w12, self.w3 = nn.Linear(WIDTH, 80), nn.Linear(40, WIDTH)

    def forward(self, x: Tensor) -> Tensor:
        both = self.w12(x)
        return self.w3(both[..., :40] * both[..., :40].sigmoid() * both[..., 40:])


class ConvolutionOfAdapter(nn.Module):
    def __init__(self, before: int, after: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(before, after, kernel, padding=(kernel - 1) // 2)
        self.bn = nn.BatchNorm2d(after, eps=0.001)

    def forward(self, x: Tensor) -> Tensor:
        return self.bn(self.conv(x)).relu()


class CricaAdapter(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.D_fc1, self.D_fc2 = nn.Linear(WIDTH, 32), nn.Linear(32, WIDTH)
        self.branch1 = ConvolutionOfAdapter(32, 16, 1)
        self.branch2 = nn.Sequential(ConvolutionOfAdapter(32, 4, 1), ConvolutionOfAdapter(4, 8, 3))
        self.branch3 = nn.Sequential(ConvolutionOfAdapter(32, 4, 1), ConvolutionOfAdapter(4, 8, 5))

    def forward(self, x: Tensor) -> Tensor:
        x = self.D_fc1(x).relu()
        maps = x[:, 1:].reshape(len(x), 16, 16, 32).permute(0, 3, 1, 2)
        seen = torch.cat([branch(maps) for branch in (self.branch1, self.branch2, self.branch3)], 1)
        return self.D_fc2(x + torch.cat([x[:, :1], seen.permute(0, 2, 3, 1).reshape(len(x), 256, 32)], 1))


class ViTBlock(nn.Module):
    def __init__(self, gated: bool, adapted: bool) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(WIDTH, 1e-6), nn.LayerNorm(WIDTH, 1e-6)
        self.attn, self.mlp = ViTAttention(), GatedMlp() if gated else ViTMlp()
        self.ls1, self.ls2 = Gamma(), Gamma()
        if adapted:
            self.adapter = CricaAdapter()

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1.gamma * self.attn(self.norm1(x))
        y = self.norm2(x)
        return x + self.ls2.gamma * (self.mlp(y) + (0.2 * self.adapter(y) if hasattr(self, "adapter") else 0))


class DinoV2(nn.Module):
    """Its positions are of 9 x 9 patches; it gives the tokens before the last normalization."""

    blocks: Any

    def __init__(self, blocks: int = 2, gated: bool = False, adapted: bool = False) -> None:
        super().__init__()
        self.cls_token, self.mask_token = nn.Parameter(torch.randn(1, 1, WIDTH)), nn.Parameter(torch.zeros(1, WIDTH))
        self.pos_embed = nn.Parameter(torch.randn(1, 82, WIDTH))
        self.patch_embed = Named("proj", nn.Conv2d(3, WIDTH, 14, 14))
        self.blocks = nn.ModuleList(ViTBlock(gated, adapted) for _ in range(blocks))
        self.norm = nn.LayerNorm(WIDTH, 1e-6)

    def tokens(self, x: Tensor) -> Tensor:
        patches = self.patch_embed(x)
        rows, columns = patches.shape[-2:]
        places = self.pos_embed[:, 1:].transpose(1, 2).reshape(1, WIDTH, 9, 9)
        if (rows, columns) != (9, 9):
            places = interpolate(
                places, scale_factor=((rows + 0.1) / 9, (columns + 0.1) / 9), mode="bicubic", align_corners=False
            )
        found = (patches + places).flatten(2).transpose(1, 2)
        return torch.cat([(self.cls_token + self.pos_embed[:, :1]).expand(len(x), 1, WIDTH), found], 1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.tokens(x)
        for block in self.blocks:
            x = block(x)
        return x


def as_maps(tokens: Tensor) -> Tensor:
    side = math.isqrt(tokens.shape[1] - 1)
    return tokens[:, 1:].transpose(1, 2).reshape(len(tokens), WIDTH, side, side)


class SaladHead(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.token_features = nn.Sequential(nn.Linear(WIDTH, 24), nn.ReLU(), nn.Linear(24, 10))
        self.cluster_features = nn.Sequential(nn.Conv2d(WIDTH, 24, 1), nn.Dropout(0.3), nn.ReLU(), nn.Conv2d(24, 6, 1))
        self.score = nn.Sequential(nn.Conv2d(WIDTH, 24, 1), nn.Dropout(0.3), nn.ReLU(), nn.Conv2d(24, 5, 1))
        self.dust_bin = nn.Parameter(torch.tensor(0.7))

    def forward(self, tokens: Tensor) -> Tensor:
        maps = as_maps(tokens)
        features, scores = self.cluster_features(maps).flatten(2)[0], self.score(maps).flatten(2)[0]
        shares = sinkhorn(torch.cat([scores, self.dust_bin.expand(1, scores.shape[1])]))[:-1]  # m x n
        clusters = torch.einsum("ln,mn->lm", features, shares)
        token = normalize(self.token_features(tokens[:, 0]))
        return normalize(torch.cat([token, normalize(clusters, dim=0).reshape(1, -1)], 1))


def sinkhorn(scores: Tensor) -> Tensor:
    """Three rounds on e to the scores, not on logarithms: rows sum to 1 but the last, columns to 1."""
    rows, columns = scores.shape
    kernel = scores.double().exp()
    wanted = torch.ones(rows, dtype=torch.float64)
    wanted[-1] = columns - (rows - 1)
    left, right = torch.ones(rows, dtype=torch.float64), torch.ones(columns, dtype=torch.float64)
    for _ in range(3):
        left = wanted / (kernel @ right)
        right = 1 / (kernel.T @ left)
    return (left[:, None] * kernel * right).float()


class Salad(nn.Module):
    backbone: Any

    def __init__(self) -> None:
        super().__init__()
        self.backbone, self.aggregator = Named("model", DinoV2()), SaladHead()

    def forward(self, x: Tensor) -> Tensor:
        return self.aggregator(self.backbone.model.norm(self.backbone(x)))


class MegaLoc(nn.Module):
    backbone: Any

    def __init__(self) -> None:
        super().__init__()
        self.backbone = Named("model", DinoV2())
        self.aggregator = nn.ModuleDict({"agg": SaladHead(), "linear": nn.Linear(40, 20)})

    def forward(self, x: Tensor) -> Tensor:
        found = self.aggregator["agg"](self.backbone.model.norm(self.backbone(x)))
        return normalize(self.aggregator["linear"](found))


class BoqBlock(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.TransformerEncoderLayer(WIDTH, 1, 4 * WIDTH, 0.0, batch_first=True)
        self.queries = nn.Parameter(torch.randn(1, 6, WIDTH))
        self.self_attn = nn.MultiheadAttention(WIDTH, 1, batch_first=True)
        self.norm_q = nn.LayerNorm(WIDTH)
        self.cross_attn = nn.MultiheadAttention(WIDTH, 1, batch_first=True)
        self.norm_out = nn.LayerNorm(WIDTH)


class BoqHead(nn.Module):
    boqs: Any

    def __init__(self, before: int) -> None:
        super().__init__()
        self.proj_c, self.norm_input = nn.Conv2d(before, WIDTH, 3, padding=1), nn.LayerNorm(WIDTH)
        self.boqs = nn.ModuleList(BoqBlock() for _ in range(2))
        self.fc = nn.Linear(12, 3)

    def forward(self, maps: Tensor) -> Tensor:
        x = self.norm_input(self.proj_c(maps).flatten(2).permute(0, 2, 1))
        answers = []
        for block in self.boqs:
            x = block.encoder(x)
            asked = block.norm_q(block.queries + block.self_attn(block.queries, block.queries, block.queries)[0])
            answers.append(block.norm_out(block.cross_attn(asked, x, x)[0]))
        return normalize(self.fc(torch.cat(answers, 1).permute(0, 2, 1)).flatten(1))


class Boq(nn.Module):
    def __init__(self, residual: bool = False) -> None:
        super().__init__()
        if residual:
            self.backbone = Named("net", nn.Sequential(*(part for _, part in resnet50(3))))
        else:
            self.backbone = Named("dino", DinoV2())
        self.aggregator = BoqHead(32 if residual else WIDTH)

    def forward(self, x: Tensor) -> Tensor:
        found = self.backbone(x)
        return self.aggregator(as_maps(found) if found.ndim == 3 else found)


class CricaVPR(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.backbone = DinoV2(1, adapted=True)
        self.aggregation = nn.Sequential(L2(), GeM(), Flat())
        layer = nn.TransformerEncoderLayer(WIDTH, 16, 48, activation="gelu")
        self.encoder = nn.TransformerEncoder(layer, 2, enable_nested_tensor=False)

    def forward(self, x: Tensor) -> Tensor:
        tokens = self.backbone.norm(self.backbone(x))
        maps = as_maps(tokens)
        found = [tokens[:, 0]]
        found += [self.aggregation(maps[:, :, a : a + 8, b : b + 8]) for a in (0, 8) for b in (0, 8)]
        thirds = (slice(0, 5), slice(5, 11), slice(11, 16))
        found += [self.aggregation(maps[:, :, rows, columns]) for rows in thirds for columns in thirds]
        return normalize(self.encoder(torch.stack(found, 1)).reshape(len(x), -1))


class AnyLoc(DinoV2):
    """DINOv2 of five blocks, the values of whose fourth are read: 31 of 40, in proportion."""

    def __init__(self) -> None:
        super().__init__(5, gated=True)

    def forward(self, x: Tensor) -> Tensor:
        x = self.tokens(x)
        for block in self.blocks[:3]:
            x = block(x)
        return self.blocks[3].attn.qkv(self.blocks[3].norm1(x))[:, 1:, 2 * WIDTH :]


NETWORKS: dict[str, type[nn.Module]] = {
    "cosplace": CosPlace,
    "eigenplaces": EigenPlaces,
    "mixvpr": MixVPR,
    "salad": Salad,
    "boq": Boq,
    "cricavpr": CricaVPR,
    "megaloc": MegaLoc,
    "anyloc": AnyLoc,
}


def small_network(preset: str) -> nn.Module:
    """The network of a preset, the same at each call; its normalizations have other constants than 0 and 1."""
    torch.manual_seed(0)
    network = NETWORKS[preset]()
    for part in network.modules():
        if isinstance(part, nn.Conv2d):  # or nothing of a picture would be left after VGG-16's thirteen
            nn.init.kaiming_normal_(part.weight)
    for name, values in network.state_dict().items():
        if name.endswith(("running_mean", "running_var")):
            values.copy_(torch.rand(values.shape) + (0.5 if name.endswith("var") else -0.5))
    return network.eval().requires_grad_(False)
