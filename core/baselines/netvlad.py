"""NetVLAD: VGG-16's conv5_3 pooled by a VLAD whose assignment is soft and learned, then whitened.

Arandjelović, Gronat, Torii, Pajdla, Sivic: NetVLAD: CNN architecture for weakly supervised place recognition,
CVPR 2016.  ``core.baselines.netvlad_files`` reads the published networks.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from core.baselines.entry import Constants, Entry, Ingredients, system_identity
from core.baselines.system import About, Description, Index, InnerProducts, stack
from core.frames.preprocessing import Pixels
from core.networks.network import ShallowNetwork
from core.networks.vgg import LAST, forward

HEIGHT, WIDTH = 480, 640
"""Of the frame as it is shown, in pixels: the pictures that the network was trained and judged on have this size."""

CONSTANTS: Constants = {
    "network": "VGG-16",
    "layer": LAST,
    "input": (HEIGHT, WIDTH),
    "words": 64,
    "normalization": "features, then intra, then global",
    "whitened": "where the file has a whitening layer (4096 values)",
}
ABOUT = About(
    "netvlad",
    "NetVLAD",
    "Arandjelović, Gronat, Torii, Pajdla, Sivic: NetVLAD: CNN architecture for weakly supervised place recognition, "
    "CVPR 2016",
    CONSTANTS,
    weights=(
        "the authors' VGG-16 network with whitening for MatConvNet, its layers turned into structures "
        "(Pitts30K_struct.mat, published with the Hierarchical-Localization toolbox), or a PyTorch port's checkpoint: "
        "pytorch-NetVlad's model_best.pth.tar or OpenIBL's vgg16_netvlad.pth."
    ),
)


def soft_assignment(features: Tensor, weights: Tensor, biases: Tensor) -> Tensor:
    """ā_k(x) = exp(w_k·x + b_k) / Σ_k' exp(w_k'·x + b_k') (eq. 3).

    Args:
        features: [N, D].
        weights: [K, D], 2α·c_k at the start of training.
        biases: [K], -α·‖c_k‖² at the start of training.

    Returns:
        [N, K], each row sums to one.
    """
    return torch.softmax(features @ weights.T + biases, dim=1)


def aggregate(features: Tensor, assignment: Tensor, centers: Tensor) -> Tensor:
    """V(j, k) = Σ_i ā_k(x_i)·(x_i(j) - c_k(j)) (eq. 4), the words first: [K, D].

    Args:
        features: [N, D].
        assignment: [N, K].
        centers: [K, D].
    """
    return assignment.T @ features - assignment.sum(0)[:, None] * centers


def unit_rows(vectors: Tensor) -> Tensor:
    """Each row divided by its length; zero stays zero."""
    return torch.nn.functional.normalize(vectors, dim=1)


@dataclass(frozen=True)
class NetVladLayer:
    """The layer of the paper's figure 2: assignment [K, D] and [K], centers [K, D]."""

    weights: Tensor
    biases: Tensor
    centers: Tensor

    def __call__(self, maps: Tensor, mask: Tensor | None = None) -> Tensor:
        """The vector of one frame, [K·D] of unit length, word by word.

        Args:
            maps: [D, X, Y], not rectified.
            mask: [X, Y], by which the assignment of each place is multiplied.
        """
        features = unit_rows(maps.flatten(1).T)  # N x D
        assignment = soft_assignment(features, self.weights, self.biases)
        if mask is not None:
            assignment = assignment * mask.reshape(-1, 1)
        vectors = unit_rows(aggregate(features, assignment, self.centers))  # intra-normalization
        return unit_rows(vectors.reshape(1, -1))[0]

    def tensors(self) -> dict[str, Tensor]:
        """What it is made of, by name."""
        return {"layer.weights": self.weights, "layer.biases": self.biases, "layer.centers": self.centers}


@dataclass(frozen=True)
class Whitening:
    """PCA whitening as one product (the paper's section 5.1): matrix [P, K·D], bias [P]."""

    matrix: Tensor
    bias: Tensor

    def __call__(self, vector: Tensor) -> Tensor:
        """[K·D] to [P] of unit length."""
        return unit_rows((self.matrix @ vector + self.bias)[None])[0]

    def tensors(self) -> dict[str, Tensor]:
        """What it is made of, by name."""
        return {"whitening.matrix": self.matrix, "whitening.bias": self.bias}


class NetVlad:
    """One vector a frame; scores are cosines.

    Args:
        network: returns conv5_3, not rectified.
    """

    sequential = False

    def __init__(
        self, network: ShallowNetwork, layer: NetVladLayer, whitening: Whitening | None, about: About = ABOUT
    ) -> None:
        from core.networks.identity import json_digest, tensors_digest

        self.about, self.network, self.layer, self.whitening = about, network, layer, whitening
        tensors = network.weights() | layer.tensors() | ({} if whitening is None else whitening.tensors())
        digests = {"network": json_digest(network.describe()), "weights": tensors_digest(tensors)}
        self.identity = system_identity(about, **digests)

    @torch.inference_mode()
    def describe(self, pixels: Pixels) -> Description:
        began = time.perf_counter()
        (maps,) = forward(self.network, pixels)
        between = time.perf_counter()
        vector = self.layer(maps)
        if self.whitening is not None:
            vector = self.whitening(vector)
        times = {"forward": 1e3 * (between - began), "vlad": 1e3 * (time.perf_counter() - between)}
        return Description({"descriptor": vector.numpy()}, times)

    def index(self, references: Sequence[Description]) -> Index:
        return InnerProducts(stack(references))


def build(ingredients: Ingredients) -> NetVlad:
    from core.baselines.netvlad_files import load_netvlad

    return NetVlad(*load_netvlad(ingredients.file()))


SYSTEMS: tuple[Entry, ...] = (Entry(ABOUT, build),)
