"""NetVLAD: VGG-16's conv5_3 pooled by a VLAD whose assignment is soft and learned, then whitened.

Arandjelović, Gronat, Torii, Pajdla, Sivic: NetVLAD: CNN architecture for weakly supervised place recognition,
CVPR 2016.

The published networks come in three layouts.  MatConvNet (the authors'): ``net.layers`` is a cell of structures with
``type``, ``name`` and ``weights``.  The custom layer ``vlad:core`` has the assignment [1, 1, D, K] and the centres with
their sign changed, in its second version the biases [1, K] between the two.  The layer ``WPCA`` after it whitens a
vector in which the word comes last.  pytorch-NetVlad: ``encoder.<i>.weight`` as torchvision numbers them,
``pool.conv.weight`` [K, D, 1, 1], ``pool.conv.bias`` [K] in its second version, ``pool.centroids`` [K, D]; its
descendants add ``WPCA.0.weight`` [P, K·D, 1, 1].  OpenIBL: the same as ``base_model.base.<i>``, ``net_vlad`` and
``pca_layer``.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from core.errors import InvalidModel
from core.frames.preprocessing import InputDefinition, Pixels
from core.networks.torch_network import TorchNetwork
from lab.baselines.system import (
    About,
    Constants,
    Description,
    InnerProducts,
    ReferenceIndex,
    Resources,
    stack,
    system_identity,
)
from lab.baselines.trunks.vgg import (
    BLOCKS,
    CONVOLUTIONS,
    IMAGENET_BGR,
    LAST,
    forward,
    load_vgg16,
    torchvision_indices,
)
from lab.conversion.checkpoints import as_float, read_checkpoint
from lab.conversion.matfiles import Unreadable, Value, is_mat, numbers, read_mat

HEIGHT, WIDTH = 480, 640
"""Of the network's input, in pixels: the network was trained and judged on images of this size."""

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

Means = tuple[float, float, float]

_TORCH_MEAN: Means = (0.485 * 255, 0.456 * 255, 0.406 * 255)
_TORCH_SCALE: Means = (1 / (0.229 * 255), 1 / (0.224 * 255), 1 / (0.225 * 255))


# The layers


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
        """All its tensors, by name."""
        return {"layer.weights": self.weights, "layer.biases": self.biases, "layer.centers": self.centers}


@dataclass(frozen=True)
class PcaWhitening:
    """PCA whitening as one product (the paper's section 5.1): matrix [P, K·D], bias [P]."""

    matrix: Tensor
    bias: Tensor

    def __call__(self, vector: Tensor) -> Tensor:
        """[K·D] to [P] of unit length."""
        return unit_rows((self.matrix @ vector + self.bias)[None])[0]

    def tensors(self) -> dict[str, Tensor]:
        """All its tensors, by name."""
        return {"whitening.matrix": self.matrix, "whitening.bias": self.bias}


# The system


class NetVlad:
    """One vector a frame; scores are cosines.

    Args:
        network: returns conv5_3, not rectified.
    """

    sequential = False

    def __init__(
        self, about: About, network: TorchNetwork, layer: NetVladLayer, whitening: PcaWhitening | None
    ) -> None:
        from core.networks.identity import json_digest
        from core.networks.torch_network import tensors_digest

        self.about, self.network, self.layer, self.whitening = about, network, layer, whitening
        tensors = network.tensors() | layer.tensors() | ({} if whitening is None else whitening.tensors())
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

    def index(self, references: Sequence[Description]) -> ReferenceIndex:
        return InnerProducts(stack(references))


def build(about: About, resources: Resources) -> NetVlad:
    return NetVlad(about, *load_netvlad(resources.file()))


# Reading the published files


Parts = tuple[TorchNetwork, NetVladLayer, PcaWhitening | None]


def load_netvlad(path: Path) -> Parts:
    """A published network: VGG-16, the layer, and the whitening if the file has one.

    Raises:
        InvalidModel: the file is of none of the layouts, or damaged.
    """
    try:
        return _from_matconvnet(read_mat(path)) if is_mat(path) else _from_torch(read_checkpoint(path))
    except InvalidModel as error:
        if path.name in str(error):
            raise
        raise InvalidModel(f"{path.name} is no NetVLAD network that can be read: {error}") from error


def _shown(mean: Means, scale: Means = (1.0, 1.0, 1.0)) -> InputDefinition:
    return InputDefinition(height=HEIGHT, width=WIDTH, channel_order="rgb", mean=mean, scale=scale)


def _check_centers(network: TorchNetwork, layer: NetVladLayer) -> None:
    depth = network.definition.convolutions()[-1].channels
    if layer.centers.shape[1] != depth:
        raise InvalidModel(f"its centres have {layer.centers.shape[1]} values, its maps {depth} channels.")


# Files of MatConvNet


def _from_matconvnet(variables: Mapping[str, Value]) -> Parts:
    net = variables.get("net")
    if not isinstance(net, dict) or not isinstance(net.get("layers"), list):
        raise InvalidModel("it has no net.layers.")
    layers: list[dict[str, Value]] = net["layers"]
    if any(isinstance(layer, Unreadable) for layer in layers):
        raise InvalidModel(
            "its layers are MATLAB objects, which only MATLAB can read; turn each into a structure there "
            "(net.layers{i} = struct(net.layers{i})) and save it with '-v7', or use the published Pitts30K_struct.mat."
        )
    if not all(isinstance(layer, dict) and isinstance(layer.get("type"), str) for layer in layers):
        raise InvalidModel("its net.layers are not a cell of structures.")
    kinds = [layer["type"] for layer in layers]
    if kinds.count("custom") < 1 or _blocks(kinds[: kinds.index("custom")]) != BLOCKS:
        raise InvalidModel("its layers are not those of VGG-16 up to conv5_3 with a VLAD layer.")
    core = kinds.index("custom")
    convolutions = [layer for layer in layers[:core] if layer["type"] == "conv"]
    network = load_vgg16(_matconvnet_vgg(convolutions), _shown(_average(net)), rectified=False)
    layer = _matconvnet_layer(_weights(layers[core]))
    _check_centers(network, layer)
    whitened = [one for one in layers[core + 1 :] if one["type"] == "conv"]
    return network, layer, _matconvnet_whitening(_weights(whitened[0]), layer) if whitened else None


def _blocks(kinds: Sequence[str]) -> tuple[int, ...]:
    """How many convolutions lie between two poolings."""
    counts = [0]
    for kind in kinds:
        counts[-1] += kind == "conv"
        if kind == "pool":
            counts.append(0)
    return tuple(counts)


def _average(net: Mapping[str, Value]) -> Means:
    """The mean colour, RGB: the first pixel of the mean image, as the authors' code takes it."""
    meta = net.get("meta")
    holder = (meta if isinstance(meta, dict) else net).get("normalization")
    if not isinstance(holder, dict) or "averageImage" not in holder:
        raise InvalidModel("it does not say the mean of its images (net.meta.normalization.averageImage).")
    red, green, blue = numbers(holder["averageImage"], "The mean of its images", None, None, 3)[0, 0].tolist()
    return red, green, blue


def _weights(layer: Mapping[str, Value]) -> list[Value]:
    weights = layer.get("weights")
    if not isinstance(weights, list) or len(weights) < 2:
        raise InvalidModel(f"its layer {str(layer.get('name'))[:40]!r} has no weights.")
    return weights


def _matconvnet_vgg(convolutions: Sequence[Mapping[str, Value]]) -> dict[str, Tensor]:
    found: dict[str, Tensor] = {}
    for name, layer in zip(CONVOLUTIONS, convolutions, strict=True):
        weight, bias = _weights(layer)[:2]
        filters = numbers(weight, f"The weight of {name}", 3, 3, None, None)  # 3 x 3 x C x K
        found[f"{name}.weight"] = torch.from_numpy(filters.transpose(3, 2, 0, 1).copy())
        found[f"{name}.bias"] = torch.from_numpy(numbers(bias, f"The bias of {name}", None, None).reshape(-1))
    return found


def _matconvnet_layer(weights: Sequence[Value]) -> NetVladLayer:
    assignment = numbers(weights[0], "The assignment", 1, 1, None, None)[0, 0]  # D x K
    depth, words = assignment.shape
    negated = numbers(weights[-1], "The centres", 1, 1, depth, words)[0, 0]
    biases = torch.zeros(words)
    if len(weights) == 3:
        biases = torch.from_numpy(numbers(weights[1], "The biases of the assignment", 1, words)[0])
    return NetVladLayer(torch.from_numpy(assignment.T.copy()), biases, torch.from_numpy(-negated.T.copy()))


def _matconvnet_whitening(weights: Sequence[Value], layer: NetVladLayer) -> PcaWhitening:
    words, depth = layer.centers.shape
    matrix = numbers(weights[0], "The whitening", 1, 1, words * depth, None)[0, 0]  # (D·K) x P
    count = matrix.shape[1]
    by_word = matrix.reshape(depth, words, count).transpose(2, 1, 0).reshape(count, words * depth)
    bias = numbers(weights[1], "The bias of the whitening", None, None).reshape(-1)
    if len(bias) != count:
        raise InvalidModel(f"The bias of the whitening has {len(bias)} values; {count} are needed.")
    return PcaWhitening(torch.from_numpy(by_word.copy()), torch.from_numpy(bias))


# Files of the PyTorch ports


def _from_torch(checkpoint: Mapping[str, Tensor]) -> Parts:
    # Trained on several devices, a network or its parts are wrapped: "module" stands between the names.
    plain = {
        ".".join(part for part in name.removeprefix("state_dict.").split(".") if part != "module"): name
        for name in checkpoint
        if not name.startswith("optimizer.")
    }
    if "net_vlad.centroids" in plain:
        encoder, pool, whitener = "base_model.base", "net_vlad", "pca_layer"
        blue, green, red = IMAGENET_BGR
        shown = _shown((red, green, blue))
    elif "pool.centroids" in plain:
        encoder, pool, whitener = "encoder", "pool", "WPCA.0"
        shown = _shown(_TORCH_MEAN, _TORCH_SCALE)
    else:
        raise InvalidModel("it has neither pool.centroids (pytorch-NetVlad) nor net_vlad.centroids (OpenIBL).")

    def read(name: str, *shape: int | None) -> Tensor:
        if name not in plain:
            raise InvalidModel(f"it has no {name}.")
        return as_float(checkpoint[plain[name]], name, *shape)

    vgg: dict[str, Tensor] = {}
    for name, index in torchvision_indices().items():
        vgg[f"{name}.weight"] = read(f"{encoder}.{index}.weight", None, None, 3, 3)
        vgg[f"{name}.bias"] = read(f"{encoder}.{index}.bias", None)
    network = load_vgg16(vgg, shown, rectified=False)
    centers = read(f"{pool}.centroids", None, None)
    words, depth = centers.shape
    biased = f"{pool}.conv.bias" in plain
    biases = read(f"{pool}.conv.bias", words) if biased else torch.zeros(words)
    layer = NetVladLayer(read(f"{pool}.conv.weight", words, depth, 1, 1)[:, :, 0, 0], biases, centers)
    _check_centers(network, layer)
    if f"{whitener}.weight" not in plain:
        return network, layer, None
    matrix = read(f"{whitener}.weight", None, words * depth, 1, 1)[:, :, 0, 0]
    return network, layer, PcaWhitening(matrix, read(f"{whitener}.bias", len(matrix)))
