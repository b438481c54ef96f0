"""What published networks make of a trunk's maps: their aggregations, with the names of their published weights."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from core.errors import InvalidModel
from lab.conversion.layouts.trunks import HEAD, Weights, count_of, shape_of

ROUNDS = 3
"""Of Sinkhorn's algorithm in SALAD."""

PYRAMID = ((0, 8, 16), (0, 5, 11, 16))
"""Where CricaVPR cuts its 16 x 16 patches, in either direction, on its two levels."""

CROSS_IMAGE_HEADS = 16
"""Of CricaVPR's encoder."""


class Unit(nn.Module):
    """Vectors of unit length, along the channels."""

    def forward(self, x: Tensor) -> Tensor:
        return normalize(x, dim=1)


class Gem(nn.Module):
    """The generalized mean of maps, 1 x K x X x Y to 1 x K."""

    def __init__(self) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.ones(1))

    def forward(self, maps: Tensor) -> Tensor:
        return (maps.clamp(min=1e-6) ** self.p).mean(dim=(2, 3)) ** (1 / self.p)


def gem_and_linear(weights: Weights, prefix: str) -> nn.Sequential:
    """The head of CosPlace and EigenPlaces: unit length, generalized mean, linear layer, unit length."""
    values, channels = shape_of(weights, f"{prefix}3.weight", 2)
    return nn.Sequential(Unit(), Gem(), nn.Identity(), nn.Linear(channels, values), Unit())


class _Mixer(nn.Module):
    def __init__(self, cells: int, hidden: int) -> None:
        super().__init__()
        self.mix = nn.Sequential(nn.LayerNorm(cells), nn.Linear(cells, hidden), nn.ReLU(), nn.Linear(hidden, cells))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.mix(x)


class MixVpr(nn.Module):
    """The head of MixVPR: whole maps are mixed, then projected along the channels, and along the cells."""

    def __init__(self, weights: Weights, prefix: str) -> None:
        super().__init__()
        rows, cells = shape_of(weights, f"{prefix}row_proj.weight", 2)
        channels, before = shape_of(weights, f"{prefix}channel_proj.weight", 2)
        count = count_of(weights, f"{prefix}mix.", ".mix.1.weight")
        hidden = shape_of(weights, f"{prefix}mix.0.mix.1.weight", 2)[0]
        self.mix = nn.Sequential(*(_Mixer(cells, hidden) for _ in range(count)))
        self.channel_proj, self.row_proj = nn.Linear(before, channels), nn.Linear(cells, rows, bias=False)

    def forward(self, maps: Tensor) -> Tensor:
        mixed = self.mix(maps.flatten(2))
        channels = self.channel_proj(mixed.transpose(1, 2)).transpose(1, 2)
        return normalize(self.row_proj(channels).flatten(1), dim=1)


class Salad(nn.Module):
    """SALAD: features go to clusters, or a dust bin, by optimal transport; 1 x (g + l·m) values."""

    def __init__(self, weights: Weights, prefix: str) -> None:
        super().__init__()

        def mlp(name: str, last: int, convolved: bool) -> nn.Sequential:
            hidden, before = shape_of(weights, f"{prefix}{name}.0.weight", 4 if convolved else 2)[:2]
            after = shape_of(weights, f"{prefix}{name}.{last}.weight", 4 if convolved else 2)[0]
            if convolved:
                first, second = nn.Conv2d(before, hidden, 1), nn.Conv2d(hidden, after, 1)
                return nn.Sequential(first, nn.Identity(), nn.ReLU(), second)
            return nn.Sequential(nn.Linear(before, hidden), nn.ReLU(), nn.Linear(hidden, after))

        self.token_features = mlp("token_features", 2, convolved=False)
        self.cluster_features = mlp("cluster_features", 3, convolved=True)
        self.score = mlp("score", 3, convolved=True)
        self.dust_bin = nn.Parameter(torch.ones(()))

    def forward(self, maps: Tensor, token: Tensor) -> Tensor:
        features = self.cluster_features(maps).flatten(2)  # 1 x l x n
        shares = self.transport(self.score(maps).flatten(2)).exp()[:, :-1]  # 1 x m x n
        clusters = normalize(features @ shares.transpose(1, 2), dim=1).flatten(1)  # l·m
        return normalize(torch.cat([normalize(self.token_features(token), dim=1), clusters], dim=1), dim=1)

    def transport(self, scores: Tensor) -> Tensor:
        """The logarithm of what each feature gives to each cluster and the dust bin: 1 x m x n to 1 x (m + 1) x n."""
        clusters, features = scores.shape[1:]
        if features <= clusters:
            raise InvalidModel(f"SALAD's {clusters} clusters need an input of more patches than {features}.")
        costs = torch.cat([scores, self.dust_bin.reshape(1, 1, 1).expand(1, 1, features)], dim=1)
        norm = -math.log(clusters + features)
        given = torch.full((1, clusters + 1), norm)
        given[0, -1] += math.log(features - clusters)
        u, v = torch.zeros(1, clusters + 1), torch.zeros(1, features)
        for _ in range(ROUNDS):
            u = given - torch.logsumexp(costs + v[:, None], dim=2)
            v = norm - torch.logsumexp(costs + u[:, :, None], dim=1)
        return costs + u[:, :, None] + v[:, None] - norm


class _Queries(nn.Module):
    def __init__(self, weights: Weights, name: str) -> None:
        super().__init__()
        _, count, width = shape_of(weights, f"{name}.queries", 3)
        if width % HEAD:
            raise InvalidModel(f"The file's {name}.queries have {width} values, not a multiple of {HEAD}.")
        heads = width // HEAD
        hidden = shape_of(weights, f"{name}.encoder.linear1.weight", 2)[0]
        self.encoder = nn.TransformerEncoderLayer(width, heads, hidden, dropout=0.0, batch_first=True)
        self.queries = nn.Parameter(torch.zeros(1, count, width))
        self.self_attn = nn.MultiheadAttention(width, heads, batch_first=True)
        self.cross_attn = nn.MultiheadAttention(width, heads, batch_first=True)
        self.norm_q, self.norm_out = nn.LayerNorm(width), nn.LayerNorm(width)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        x = self.encoder(x)
        asked = self.norm_q(self.queries + self.self_attn(self.queries, self.queries, self.queries)[0])
        return x, self.norm_out(self.cross_attn(asked, x, x)[0])


class Boq(nn.Module):
    """The head of BoQ: learned queries ask the maps, layer after layer."""

    def __init__(self, weights: Weights, prefix: str) -> None:
        super().__init__()
        width, before = shape_of(weights, f"{prefix}proj_c.weight", 4)[:2]
        self.proj_c, self.norm_input = nn.Conv2d(before, width, 3, padding=1), nn.LayerNorm(width)
        count = count_of(weights, f"{prefix}boqs.", ".queries")
        self.boqs = nn.ModuleList(_Queries(weights, f"{prefix}boqs.{at}") for at in range(count))
        rows, answers = shape_of(weights, f"{prefix}fc.weight", 2)
        self.fc = nn.Linear(answers, rows)

    def forward(self, maps: Tensor) -> Tensor:
        x = self.norm_input(self.proj_c(maps).flatten(2).transpose(1, 2))
        found = []
        for block in self.boqs:
            x, answer = block(x)
            found.append(answer)
        return normalize(self.fc(torch.cat(found, dim=1).transpose(1, 2)).flatten(1), dim=1)


class Pyramid(nn.Module):
    """The parts of CricaVPR's pyramid, 1 x 14 x D: the class token, then the means of 4 and of 9 parts of the map."""

    def __init__(self) -> None:
        super().__init__()
        self.mean = nn.Sequential(Unit(), Gem())

    def forward(self, maps: Tensor, token: Tensor) -> Tensor:
        parts = [token]
        for cuts in PYRAMID:
            edges = list(pairwise(cuts))
            parts += [self.mean(maps[:, :, a:b, c:d]) for a, b in edges for c, d in edges]
        return torch.stack(parts, dim=1)
