"""NetVLAD's layer held to its paper's equations, and the three published layouts to a network told by hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from scipy.io import savemat
from scipy.io.matlab import MatlabObject

from core.errors import InvalidModel
from core.method.equations import assign, residuals
from lab.baselines.netvlad import (
    ABOUT,
    NetVlad,
    NetVladLayer,
    PcaWhitening,
    aggregate,
    load_netvlad,
    soft_assignment,
)
from lab.baselines.trunks.vgg import torchvision_indices
from lab.conversion import checkpoints, matfiles
from tests.lab.conversion import in_process
from tests.lab.conversion.vgg_writer import blocks, plain_maps, plain_vgg

Array = NDArray[Any]

# The layer


def by_the_equations(features: Array, weights: Array, biases: Array, centers: Array) -> Array:
    """V(j, k) of the paper's equation 4 with the assignment of equation 3, term by term: [K, D]."""
    words, depth = centers.shape
    vectors = np.zeros((words, depth))
    for x in features:
        exponents = [np.exp(weights[k] @ x + biases[k]) for k in range(words)]
        for k in range(words):
            for j in range(depth):
                vectors[k, j] += exponents[k] / sum(exponents) * (x[j] - centers[k, j])
    return vectors


def normalized(vectors: Array) -> Array:
    """Each word's vector by its own length, then the whole by its length."""
    vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray((vectors / np.linalg.norm(vectors)).reshape(-1))


def test_two_features_by_hand() -> None:
    features = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    centers = torch.tensor([[1.0, 1.0], [0.0, 0.0]])
    weights, biases = torch.log(torch.tensor([[3.0, 1.0], [1.0, 1.0]])), torch.zeros(2)
    assignment = soft_assignment(features, weights, biases)
    torch.testing.assert_close(assignment, torch.tensor([[0.75, 0.25], [0.5, 0.5]]))
    # word 1: 0.75·(0, -1) + 0.5·(-1, 0); word 2: 0.25·(1, 0) + 0.5·(0, 1)
    torch.testing.assert_close(aggregate(features, assignment, centers), torch.tensor([[-0.5, -0.75], [0.25, 0.5]]))


def test_the_layer_follows_the_equations() -> None:
    random = np.random.default_rng(0)
    maps = random.standard_normal((5, 3, 4)).astype(np.float32)
    weights, centers = random.standard_normal((2, 6, 5)).astype(np.float32)
    biases = random.standard_normal(6).astype(np.float32)
    layer = NetVladLayer(*(torch.from_numpy(array) for array in (weights, biases, centers)))
    found = layer(torch.from_numpy(maps)).numpy()
    features = maps.reshape(5, 12).T
    features = features / np.linalg.norm(features, axis=1, keepdims=True)
    np.testing.assert_allclose(found, normalized(by_the_equations(features, weights, biases, centers)), atol=1e-6)
    assert found.shape == (30,) and np.linalg.norm(found) == pytest.approx(1)


def test_the_assignment_of_the_start_becomes_hard_as_alpha_grows() -> None:
    """Equation 3 is equation 2 for w = 2αc, b = -α‖c‖²; for a large α it is VLAD's (the paper's section 3.1)."""
    random = np.random.default_rng(1)
    features = random.standard_normal((40, 5)).astype(np.float32)
    centers = random.standard_normal((4, 5)).astype(np.float32)
    for alpha in (0.7, 1000.0):
        weights = torch.from_numpy(2 * alpha * centers)
        biases = torch.from_numpy(-alpha * (centers**2).sum(1))
        soft = soft_assignment(torch.from_numpy(features), weights, biases).numpy()
        distances = ((features[:, None] - centers) ** 2).sum(2)
        wanted = np.exp(-alpha * (distances - distances.min(1, keepdims=True)))
        np.testing.assert_allclose(soft, wanted / wanted.sum(1, keepdims=True), atol=1e-4)
    assert (soft.argmax(1) == assign(features, centers)).all() and (soft.max(1) > 0.999).mean() > 0.9
    hard = aggregate(*(torch.from_numpy(array) for array in (features, soft, centers))).numpy()
    np.testing.assert_allclose(hard, residuals(features, centers), atol=1e-2)


def test_a_mask_weights_the_places() -> None:
    random = np.random.default_rng(2)
    maps = torch.from_numpy(random.standard_normal((3, 2, 2)).astype(np.float32))
    layer = NetVladLayer(torch.rand(2, 3), torch.zeros(2), torch.rand(2, 3))
    one_place = torch.tensor([[0.0, 0.0], [2.0, 0.0]])
    torch.testing.assert_close(layer(maps, one_place), layer(maps[:, 1:, :1]))


def test_nothing_gives_no_nan() -> None:
    layer = NetVladLayer(torch.zeros(2, 3), torch.zeros(2), torch.zeros(2, 3))
    assert layer(torch.zeros(3, 2, 2)).tolist() == [0.0] * 6


# Files


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are read in this process; tests/core/networks reads them in one of their own."""
    for module in (checkpoints, matfiles):
        in_process.use(monkeypatch, module.__name__)


WORDS, DEPTH, VALUES = 2, 3, 4
RANDOM = np.random.default_rng(3)
ASSIGNMENT = RANDOM.standard_normal((WORDS, DEPTH)).astype(np.float32)
CENTERS = RANDOM.standard_normal((WORDS, DEPTH)).astype(np.float32)
BIASES = RANDOM.standard_normal(WORDS).astype(np.float32)
WHITENING = RANDOM.standard_normal((VALUES, WORDS, DEPTH)).astype(np.float32)
WHITENED = RANDOM.standard_normal(VALUES).astype(np.float32)
FRAME = blocks(480, 640)

MATCONVNET_MEAN = (123.68, 116.779, 103.939)


def told_by_hand(
    mean: tuple[float, float, float],
    deviation: tuple[float, float, float] | None = None,
    biases: Array | None = None,
    whitened: bool = False,
) -> Array:
    """The vector of ``FRAME`` by a network that hands its maps on, with the sign of conv5_3 changed."""
    maps = plain_maps(FRAME[:, :, ::-1], mean, last=-1)
    if deviation is not None:
        maps /= np.array(deviation, np.float32)[:, None, None]
    features = maps.reshape(DEPTH, -1).T.astype(np.float64)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    distinct, counts = np.unique(features, axis=0, return_counts=True)
    vectors = sum(
        count * by_the_equations(x[None], ASSIGNMENT, np.zeros(WORDS) if biases is None else biases, CENTERS)
        for x, count in zip(distinct, counts, strict=True)
    )
    vector = normalized(np.asarray(vectors))
    if whitened:
        vector = WHITENING.reshape(VALUES, -1) @ vector + WHITENED
        vector /= np.linalg.norm(vector)
    return vector


def cell(*values: Any) -> Array:
    row = np.empty((1, len(values)), object)
    row[0, :] = values
    return row


def matconvnet(core: Any, whitened: bool = True, vgg: dict[str, Array] | None = None) -> dict[str, Any]:
    """The structure ``net`` as the authors' code builds it."""
    layers: list[Any] = []
    vgg = plain_vgg(last=-1) if vgg is None else vgg
    for name in [key.removesuffix(".weight") for key in vgg if key.endswith(".weight")]:
        if name.endswith("_1") and layers:
            layers.append({"type": "pool", "name": f"pool{name[4]}", "method": "max", "pool": np.array([[2.0, 2.0]])})
            layers.append({"type": "relu", "name": f"relu{name[4]}"})
        elif layers:
            layers.append({"type": "relu", "name": "relu"})
        weights = cell(vgg[f"{name}.weight"].transpose(2, 3, 1, 0), vgg[f"{name}.bias"][None])
        layers.append({"type": "conv", "name": name, "weights": weights, "pad": 1.0, "stride": 1.0})
    layers.append({"type": "normalize", "name": "preL2", "param": np.array([[2.0 * DEPTH, 1e-12, 1, 0.5]])})
    layers.append(core)
    layers.append({"type": "normalize", "name": "vlad:intranorm"})
    layers.append({"type": "custom", "name": "postL2"})
    if whitened:
        # MATLAB flattens K x D column by column: the word runs fastest.
        matrix = WHITENING.transpose(2, 1, 0).reshape(1, 1, DEPTH * WORDS, VALUES)
        layers.append({"type": "conv", "name": "WPCA", "weights": cell(matrix, WHITENED[:, None])})
        layers.append({"type": "custom", "name": "finalL2"})
    average = np.array(MATCONVNET_MEAN).reshape(1, 1, 3)
    return {"layers": cell(*layers), "meta": {"normalization": {"averageImage": average}, "epoch": 30.0}}


def vlad_core(biased: bool = False) -> dict[str, Any]:
    parts = [ASSIGNMENT.T[None, None], -CENTERS.T[None, None]]
    if biased:
        parts.insert(1, BIASES[None])
    return {"type": "custom", "name": "vlad:core", "K": float(WORDS), "D": float(DEPTH), "weights": cell(*parts)}


def describe(path: Path) -> Array:
    system = NetVlad(ABOUT, *load_netvlad(path))
    description = system.describe(FRAME)
    assert set(description.milliseconds) == {"forward", "vlad"}
    assert system.identity.startswith("netvlad@")
    return np.asarray(description.arrays["descriptor"])


@pytest.mark.parametrize(("biased", "whitened"), [(False, True), (False, False), (True, True)])
def test_the_authors_file(tmp_path: Path, biased: bool, whitened: bool) -> None:
    path = tmp_path / "Pitts30K_struct.mat"
    savemat(path, {"net": matconvnet(vlad_core(biased), whitened)}, do_compression=True)
    wanted = told_by_hand(MATCONVNET_MEAN, biases=BIASES if biased else None, whitened=whitened)
    found = describe(path)
    assert found.shape == ((VALUES,) if whitened else (WORDS * DEPTH,)) and found.dtype == np.float32
    np.testing.assert_allclose(found, wanted, atol=2e-5)


def test_the_authors_filters_are_turned_the_right_way(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    vgg = {name: random.standard_normal(weight.shape).astype(np.float32) for name, weight in plain_vgg().items()}
    savemat(tmp_path / "a.mat", {"net": matconvnet(vlad_core(), vgg=vgg)})
    network, _, _ = load_netvlad(tmp_path / "a.mat")
    found = network.tensors()
    assert sorted(found) == sorted(vgg)
    for name, weight in vgg.items():
        np.testing.assert_array_equal(found[name].numpy(), weight)


def port(whitened: bool = False, biased: bool = False, wrapped: bool = False) -> dict[str, torch.Tensor]:
    """The tensors of pytorch-NetVlad's checkpoint, ``wrapped`` as several devices leave them."""
    between = "module." if wrapped else ""
    vgg = plain_vgg(last=-1)
    found: dict[str, Array] = {}
    for name, index in torchvision_indices().items():
        for kind in ("weight", "bias"):
            found[f"encoder.{between}{index}.{kind}"] = vgg[f"{name}.{kind}"]
    found[f"pool.{between}centroids"] = CENTERS
    found[f"pool.{between}conv.weight"] = ASSIGNMENT[:, :, None, None]
    if biased:
        found[f"pool.{between}conv.bias"] = BIASES
    if whitened:
        found["WPCA.0.weight"] = WHITENING.reshape(VALUES, -1, 1, 1)
        found["WPCA.0.bias"] = WHITENED
    return {name: torch.from_numpy(array.copy()) for name, array in found.items()}


@pytest.mark.parametrize(
    ("layout", "whitened", "biased", "wrapped"),
    [("zip", 1, 0, 0), ("older", 0, 1, 1), *(("safetensors", *flags) for flags in ((0, 0, 0), (1, 0, 0), (0, 1, 1)))],
)
def test_the_port_to_pytorch(tmp_path: Path, layout: str, whitened: bool, biased: bool, wrapped: bool) -> None:
    path = tmp_path / "model_best.pth.tar"
    tensors = port(whitened, biased, wrapped)
    if layout == "safetensors":
        save_file(tensors, path)
    else:
        state = {"epoch": 30, "best_score": np.float64(0.9), "state_dict": tensors, "parallel": wrapped}
        torch.save(state, path, _use_new_zipfile_serialization=layout == "zip")
    mean, deviation = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
    wanted = told_by_hand(mean, deviation, BIASES if biased else None, whitened)
    np.testing.assert_allclose(describe(path), wanted, atol=2e-5)


def test_openibl(tmp_path: Path) -> None:
    names = {"encoder": "base_model.base", "pool": "net_vlad", "WPCA.0": "pca_layer"}
    tensors = port(whitened=True)
    for old, new in names.items():
        tensors = {name.replace(f"{old}.", f"{new}.", 1): tensor for name, tensor in tensors.items()}
    torch.save(tensors, tmp_path / "vgg16_netvlad.pth")
    wanted = told_by_hand(MATCONVNET_MEAN, whitened=True)
    np.testing.assert_allclose(describe(tmp_path / "vgg16_netvlad.pth"), wanted, atol=2e-5)


def test_identities_tell_weights_apart(tmp_path: Path) -> None:
    identities = set()
    for change in (0.0, 0.5):
        tensors = port()
        tensors["pool.centroids"] += change
        save_file(tensors, tmp_path / "a.safetensors")
        identities.add(NetVlad(ABOUT, *load_netvlad(tmp_path / "a.safetensors")).identity)
    assert len(identities) == 2


def test_objects_of_matlab_get_the_remedy(tmp_path: Path) -> None:
    inside = np.zeros((1, 1), [("K", object)])
    inside[0, 0]["K"] = np.array([[64.0]])
    savemat(tmp_path / "a.mat", {"net": matconvnet(MatlabObject(inside, "layerVLAD"))})
    with pytest.raises(
        InvalidModel, match=r"a\.mat .* MATLAB objects.*struct\(net\.layers\{i\}\).*Pitts30K_struct\.mat"
    ):
        load_netvlad(tmp_path / "a.mat")


def without_mean(net: dict[str, Any]) -> None:
    del net["meta"]["normalization"]


def without_a_pooling(net: dict[str, Any]) -> None:
    kinds = [layer["type"] for layer in net["layers"][0]]
    net["layers"] = np.delete(net["layers"], kinds.index("pool"), axis=1)


@pytest.mark.parametrize("spoil", [without_mean, without_a_pooling, lambda net: net.pop("layers")])
def test_other_networks_of_matconvnet(tmp_path: Path, spoil: Callable[[dict[str, Any]], None]) -> None:
    net = matconvnet(vlad_core())
    spoil(net)
    savemat(tmp_path / "a.mat", {"net": net})
    with pytest.raises(InvalidModel, match=r"a\.mat is no NetVLAD network that can be read"):
        load_netvlad(tmp_path / "a.mat")


@pytest.mark.parametrize(
    ("name", "tensor"),
    [
        ("pool.centroids", torch.rand(WORDS, DEPTH + 1)),
        ("pool.conv.weight", torch.rand(WORDS, DEPTH, 3, 3)),
        ("pool.conv.bias", torch.rand(WORDS + 1)),
        ("encoder.28.bias", torch.full((3,), float("nan"))),
        ("WPCA.0.weight", torch.rand(VALUES, 5, 1, 1)),
        ("encoder.0.weight", None),
        ("pool.conv.weight", None),
        ("pool.centroids", None),
    ],
)
def test_tensors_that_do_not_fit(tmp_path: Path, name: str, tensor: torch.Tensor | None) -> None:
    tensors = port() | ({name: tensor} if tensor is not None else {})
    if tensor is None:
        del tensors[name]
    save_file(tensors, tmp_path / "a.safetensors")
    with pytest.raises(InvalidModel, match=r"a\.safetensors is no NetVLAD network"):
        load_netvlad(tmp_path / "a.safetensors")


def test_centres_of_another_depth(tmp_path: Path) -> None:
    tensors = port() | {"pool.centroids": torch.rand(2, 4), "pool.conv.weight": torch.rand(2, 4, 1, 1)}
    save_file(tensors, tmp_path / "a.safetensors")
    with pytest.raises(InvalidModel, match="centres have 4 values, its maps 3 channels"):
        load_netvlad(tmp_path / "a.safetensors")


def test_whitening_by_hand() -> None:
    found = PcaWhitening(torch.tensor([[1.0, 0.0], [0.0, 2.0]]), torch.tensor([2.0, 2.0]))(torch.tensor([1.0, 1.0]))
    torch.testing.assert_close(found, torch.tensor([0.6, 0.8]))


def test_it_says_which_file_it_needs() -> None:
    assert ABOUT.weights is not None and "Pitts30K_struct.mat" in ABOUT.weights and "vgg16_netvlad.pth" in ABOUT.weights
