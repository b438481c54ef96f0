"""The systems with attention: their equations term by term, and files of each layout told by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import nn

from core.baselines.attention import SYSTEMS, Attention, FixedContext, FlexibleContext
from core.baselines.entry import Entry, Ingredients
from core.baselines.system import System
from core.errors import InvalidModel
from core.method.catalogue import EncoderCatalogue
from tests.core.baselines.test_netvlad import by_the_equations, normalized
from tests.core.networks.caffe_writer import Layer, caffemodel, field, layer, relu
from tests.core.networks.test_resnet import small_resnet
from tests.core.networks.vgg_writer import blocks, plain_maps, plain_vgg

Array = NDArray[Any]
ENTRIES: dict[str, Entry] = {entry.about.name: entry for entry in SYSTEMS}
IMAGENET = (103.939, 116.779, 123.68)


def build(name: str, path: Path) -> System:
    return ENTRIES[name].build(Ingredients(EncoderCatalogue(), path))


def vector(system: System, picture: NDArray[np.uint8]) -> Array:
    return np.asarray(system.describe(picture).arrays["descriptor"])


def slid(maps: Array, weight: Array, bias: Array) -> Array:
    """A convolution over a border of zeros, window by window: [C, X, Y]."""
    side = weight.shape[-1] // 2
    seen = np.pad(maps, ((0, 0), (side, side), (side, side)))
    _, height, width = maps.shape
    windows = [[seen[:, y : y + 2 * side + 1, x : x + 2 * side + 1] for x in range(width)] for y in range(height)]
    return np.asarray(np.einsum("yxdij,cdij->cyx", np.array(windows), weight) + bias[:, None, None])


# Fix-Context


RANDOM = np.random.default_rng(0)
WINDOWS = [
    (
        RANDOM.normal(0, 0.02, (channels, 3, side, side)).astype(np.float32),
        RANDOM.normal(0, 1, channels).astype(np.float32),
    )
    for channels, side in ((2, 5), (2, 3), (1, 7))
]
SUMMING = np.array([1, 0.5, 1, 1, 2], np.float32).reshape(1, 5, 1, 1)
OFFSET = np.array([-0.1], np.float32)
BILINEAR = np.outer([0.25, 0.75, 0.75, 0.25], [0.25, 0.75, 0.75, 0.25]).astype(np.float32)
ASSIGNMENT, CENTERS = RANDOM.normal(0, 1, (2, 2, 3)).astype(np.float32)


def context_by_hand(maps: Array) -> Array:
    """The mask [X, Y] of the reweighting network."""
    _, height, width = maps.shape
    rows, columns = range(0, height - 1, 2), range(0, width - 1, 2)
    small = np.array([[[plane[y : y + 3, x : x + 3].mean() for x in columns] for y in rows] for plane in maps])
    contexts = np.concatenate([np.maximum(slid(small, weight, bias), 0) for weight, bias in WINDOWS])
    weights = np.maximum(np.einsum("c,cyx->yx", SUMMING.reshape(-1), contexts) + OFFSET, 0)
    mask = np.zeros((height + 2, width + 2))
    for y, row in enumerate(weights):
        for x, weight in enumerate(row):
            mask[2 * y : 2 * y + 4, 2 * x : 2 * x + 4] += weight * BILINEAR
    return mask[1:-1, 1:-1]


def test_the_mask_of_fixed_windows() -> None:
    maps = RANDOM.normal(0, 20, (3, 8, 10)).astype(np.float32)
    pairs = tuple((torch.from_numpy(weight), torch.from_numpy(bias)) for weight, bias in WINDOWS)
    summing = torch.from_numpy(SUMMING), torch.from_numpy(OFFSET)
    context = FixedContext(pairs, summing, torch.from_numpy(BILINEAR)[None, None])
    found = context(torch.from_numpy(maps)).numpy()
    np.testing.assert_allclose(found, context_by_hand(maps), rtol=1e-4, atol=1e-4)
    assert found.shape == (8, 10) and found.std() > 0.1


def crn() -> list[Layer]:
    """The layers of the authors' network under their names, as training leaves them in a file."""
    vgg = plain_vgg(last=-1)
    layers = []
    for name in [key.removesuffix(".weight") for key in vgg if key.endswith(".weight")]:
        blobs = (vgg[f"{name}.weight"], vgg[f"{name}.bias"])
        layers.append(layer(f"{name}_v", "Convolution", "data", blobs=blobs))
        layers.append(relu(f"{name.replace('conv', 'relu')}_v", f"{name}_v"))
    for name, blobs in zip(("single", "single_2", "single_3"), WINDOWS, strict=True):
        layers.append(layer(f"rw_conv6/{name}", "Convolution", "rw_conv6/pool", blobs=blobs))
    return [
        *layers,
        layer("rw_map/single", "Convolution", "concat_6", blobs=(SUMMING, OFFSET)),
        layer("upsample", "Deconvolution", "rw_map/single", blobs=(BILINEAR[None, None],)),
        layer("vlad_conv", "Convolution", "vlad_preL2", blobs=(ASSIGNMENT[:, :, None, None],)),
        layer("vlad_core", "Netvlad", "spfilter7 vlad_preL2", blobs=(-CENTERS,)),
    ]


@pytest.mark.parametrize("form", ["new", "old"])
def test_fix_context_reads_the_authors_network(tmp_path: Path, form: str) -> None:
    path = tmp_path / "rw_netvlad_vgg.caffemodel"
    path.write_bytes(caffemodel(crn(), form=form))
    system = build("fix-context", path)
    picture = blocks(480, 640)
    found = vector(system, picture)

    maps = plain_maps(picture, IMAGENET, last=-1).astype(np.float64)
    features = maps.reshape(3, -1).T
    features = features / np.linalg.norm(features, axis=1, keepdims=True)
    mask = context_by_hand(maps).reshape(-1)
    vectors = np.zeros((2, 3))
    for weight, x in zip(mask, features, strict=True):
        vectors += weight * by_the_equations(x[None], ASSIGNMENT, np.zeros(2), CENTERS)
    np.testing.assert_allclose(found, normalized(vectors), atol=2e-5)
    assert mask.std() > 0.1 and system.identity.startswith("fix-context@")


def test_a_layer_that_is_missing_or_does_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "a.caffemodel"
    path.write_bytes(caffemodel([one for one in crn() if one["name"] != "rw_map/single"]))
    with pytest.raises(InvalidModel, match=r"a\.caffemodel: the layer rw_map/single has 0 arrays of weights, not 2"):
        build("fix-context", path)
    layers = [one | ({"blobs": (CENTERS[:, :2],)} if one["name"] == "vlad_core" else {}) for one in crn()]
    path.write_bytes(caffemodel(layers))
    with pytest.raises(InvalidModel, match="vlad_core has the shape"):
        build("fix-context", path)
    path.write_bytes(field(1, "nothing"))
    with pytest.raises(InvalidModel, match="conv1_1_v"):
        build("fix-context", path)


# Attentive Attention


def test_attention_by_hand() -> None:
    hidden = torch.tensor([[1.0, 0.0], [-1.0, 1.0]])[:, :, None, None], torch.tensor([0.0, 1.0])
    score = torch.tensor([2.0, -1.0])[None, :, None, None], torch.tensor([0.5])
    found = Attention(hidden, score)(torch.tensor([[[[1.0, 3.0]], [[2.0, 0.0]]]]))
    # (1, 2): relu(1, 2) gives 2 - 2 + 0.5; (3, 0): relu(3, -2) gives 6 + 0.5
    np.testing.assert_allclose(found.numpy(), [[[np.log1p(np.exp([0.5, 6.5]))]]], rtol=1e-6)


@pytest.mark.parametrize("zipped", [True, False])
def test_attentive_attention_reads_a_checkpoint_of_the_port(tmp_path: Path, zipped: bool) -> None:
    base = small_resnet()
    conv1, conv2 = nn.Conv2d(9, 6, 1), nn.Conv2d(6, 1, 1)
    attention = nn.ModuleDict({"conv1": conv1, "conv2": conv2})
    state = {
        "epoch": 2,
        "acc": 55.5,
        "base": base.state_dict(),
        "attn": attention.state_dict(),
        "pool": {},
        "logits": {"0.weight": torch.rand(5, 9, 1, 1), "0.bias": torch.rand(5)},
    }
    path = tmp_path / "bestshot.pth.tar"
    torch.save(state, path, _use_new_zipfile_serialization=zipped)
    picture = np.random.default_rng(0).integers(0, 256, (224, 224, 3), np.uint8)
    system = build("attentive-attention", path)
    found = vector(system, picture)

    with torch.inference_mode():
        maps = base(torch.from_numpy(picture[:, :, ::-1].copy()).permute(2, 0, 1)[None] / 255)
        alpha = nn.functional.softplus(conv2(conv1(maps).relu()))[0, 0].numpy()
    summed = np.zeros(9)
    for y, x in np.ndindex(14, 14):
        feature = maps[0, :, y, x].numpy()
        summed += alpha[y, x] * feature / np.linalg.norm(feature)
    np.testing.assert_allclose(found, summed / np.linalg.norm(summed), atol=1e-5)
    assert system.index([system.describe(picture)]).compare([system.describe(picture)])[0, 0] == pytest.approx(1)


def test_a_checkpoint_without_attention(tmp_path: Path) -> None:
    path = tmp_path / "a.pth"
    torch.save({"base": small_resnet().state_dict()}, path)
    with pytest.raises(InvalidModel, match=r"a\.pth has no DELF network with attention: it has no conv1\.weight"):
        build("attentive-attention", path)
    torch.save({"base": small_resnet().state_dict(), "attn": {"conv1.weight": torch.rand(6, 8, 1, 1)}}, path)
    with pytest.raises(InvalidModel, match=r"it has no conv1\.bias"):
        build("attentive-attention", path)


# Context Flexible Attention


def flexible() -> dict[str, Array]:
    """The tensors of the layout: two windows on the first two layers, one on the last."""
    random = np.random.default_rng(4)
    tensors = dict(plain_vgg())
    for name, sides in (("conv5_1", (1, 5)), ("conv5_2", (3, 3)), ("conv5_3", (7,))):
        for index, side in enumerate(sides):
            tensors[f"context.{name}.{index}.weight"] = random.normal(0, 0.01, (2, 3, side, side)).astype(np.float32)
            tensors[f"context.{name}.{index}.bias"] = random.normal(0, 0.5, 2).astype(np.float32)
        tensors[f"score.{name}.weight"] = random.normal(0, 1, (1, 2 * len(sides), 1, 1)).astype(np.float32)
        tensors[f"score.{name}.bias"] = random.normal(0, 1, 1).astype(np.float32)
    tensors["fusion.weight"] = np.array([0.5, -1, 1], np.float32).reshape(1, 3, 1, 1)
    tensors["fusion.bias"] = np.array([0.25], np.float32)
    return tensors


def write(path: Path, tensors: dict[str, Array]) -> Path:
    save_file({name: torch.from_numpy(tensor.copy()) for name, tensor in tensors.items()}, path)
    return path


def flexible_mask(maps: Array, tensors: dict[str, Array]) -> Array:
    """The mask [X, Y] where all three layers have the same maps."""
    total = np.full(maps.shape[1:], 0.25)
    for factor, name, count in ((0.5, "conv5_1", 2), (-1, "conv5_2", 2), (1, "conv5_3", 1)):
        pairs = [[tensors[f"context.{name}.{i}.{kind}"] for kind in ("weight", "bias")] for i in range(count)]
        seen = np.concatenate([np.maximum(slid(maps, weight, bias), 0) for weight, bias in pairs])
        score = np.einsum("c,cyx->yx", tensors[f"score.{name}.weight"].reshape(-1), seen)
        total += factor * (score + tensors[f"score.{name}.bias"])
    return np.asarray(np.log1p(np.exp(total)))


def test_context_flexible_attention_of_a_file(tmp_path: Path) -> None:
    picture = blocks(224, 224)
    tensors = flexible()
    system = build("context-flexible-attention", write(tmp_path / "a.safetensors", tensors))
    found = vector(system, picture)
    maps = plain_maps(picture, IMAGENET).astype(np.float64)
    mask = flexible_mask(maps, tensors)
    wanted = (maps * mask).reshape(-1)
    assert found.shape == (3 * 14 * 14,) and mask.std() > 0.1
    np.testing.assert_allclose(found, wanted / np.linalg.norm(wanted), atol=1e-5)
    torch.save({name: torch.from_numpy(tensor) for name, tensor in tensors.items()}, tmp_path / "a.pth")
    again = build("context-flexible-attention", tmp_path / "a.pth")
    assert again.identity == system.identity
    np.testing.assert_array_equal(vector(again, picture), found)


def test_the_mask_uses_each_layer() -> None:
    windows = (((torch.ones(1, 1, 1, 1), torch.zeros(1)),),) * 3
    scores = ((torch.ones(1, 1, 1, 1), torch.zeros(1)),) * 3
    context = FlexibleContext(windows, scores, (torch.tensor([1.0, 2.0, 4.0]).reshape(1, 3, 1, 1), torch.zeros(1)))
    found = context([torch.full((1, 1, 1), value) for value in (1.0, 0.5, 0.25)])
    assert found.item() == pytest.approx(np.log1p(np.exp(3)))


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("context.conv5_1.0.weight", None),
        ("context.conv5_1.0.weight", (2, 4, 3, 3)),
        ("context.conv5_1.0.weight", (2, 3, 2, 2)),
        ("context.conv5_2.1.bias", (3,)),
        ("score.conv5_3.weight", (1, 9, 1, 1)),
        ("fusion.weight", (1, 2, 1, 1)),
        ("conv4_1.weight", None),
    ],
)
def test_tensors_that_do_not_fit(tmp_path: Path, name: str, shape: tuple[int, ...] | None) -> None:
    tensors = flexible()
    if shape is None:
        del tensors[name]
    else:
        tensors[name] = np.zeros(shape, np.float32)
    with pytest.raises(InvalidModel, match=r"a\.safetensors has no network with context flexible attention"):
        build("context-flexible-attention", write(tmp_path / "a.safetensors", tensors))


def test_a_blank_frame_has_a_description(tmp_path: Path) -> None:
    system = build("context-flexible-attention", write(tmp_path / "a.safetensors", flexible()))
    blank = system.describe(np.zeros((30, 40, 3), np.uint8))
    assert not np.asarray(blank.arrays["descriptor"]).any()
    assert system.index([blank]).compare([blank]).tolist() == [[0]]


def test_each_says_which_file_it_needs() -> None:
    for entry in SYSTEMS:
        assert entry.about.weights is not None and entry.about.weights.endswith(".")
