"""Fix-Context: its mask by hand, and the authors' file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from core.errors import InvalidModel
from core.method.catalogue import EncoderCatalogue
from lab.baselines import registry
from lab.baselines.attention.fix_context import FixedContext
from lab.baselines.system import System
from tests.lab.baselines.test_netvlad import by_the_equations, normalized
from tests.lab.conversion.caffe_writer import Layer, caffemodel, field, layer, relu
from tests.lab.conversion.vgg_writer import blocks, plain_maps, plain_vgg

Array = NDArray[Any]
IMAGENET = (103.939, 116.779, 123.68)


def build(path: Path) -> System:
    return registry.build("fix-context", models=EncoderCatalogue(), weights=path)


def vector(system: System, frame: NDArray[np.uint8]) -> Array:
    return np.asarray(system.describe(frame).arrays["descriptor"])


def slid(maps: Array, weight: Array, bias: Array) -> Array:
    """A convolution over a border of zeros, window by window: [C, X, Y]."""
    side = weight.shape[-1] // 2
    seen = np.pad(maps, ((0, 0), (side, side), (side, side)))
    _, height, width = maps.shape
    windows = [[seen[:, y : y + 2 * side + 1, x : x + 2 * side + 1] for x in range(width)] for y in range(height)]
    return np.asarray(np.einsum("yxdij,cdij->cyx", np.array(windows), weight) + bias[:, None, None])


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


@pytest.mark.thorough
@pytest.mark.parametrize("form", ["new", "old"])
def test_fix_context_reads_the_authors_network(tmp_path: Path, form: str) -> None:
    path = tmp_path / "rw_netvlad_vgg.caffemodel"
    path.write_bytes(caffemodel(crn(), form=form))
    system = build(path)
    frame = blocks(480, 640)
    found = vector(system, frame)

    maps = plain_maps(frame, IMAGENET, last=-1).astype(np.float64)
    features = maps.reshape(3, -1).T
    features = features / np.linalg.norm(features, axis=1, keepdims=True)
    mask = context_by_hand(maps).reshape(-1)
    vectors = np.zeros((2, 3))
    for weight, x in zip(mask, features, strict=True):
        vectors += weight * by_the_equations(x[None], ASSIGNMENT, np.zeros(2), CENTERS)
    np.testing.assert_allclose(found, normalized(vectors), atol=2e-5)
    assert mask.std() > 0.1 and system.identity.startswith("fix-context@")


@pytest.mark.thorough
def test_a_layer_that_is_missing_or_does_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "a.caffemodel"
    path.write_bytes(caffemodel([one for one in crn() if one["name"] != "rw_map/single"]))
    with pytest.raises(InvalidModel, match=r"a\.caffemodel: the layer rw_map/single has 0 arrays of weights, not 2"):
        build(path)
    layers = [one | ({"blobs": (CENTERS[:, :2],)} if one["name"] == "vlad_core" else {}) for one in crn()]
    path.write_bytes(caffemodel(layers))
    with pytest.raises(InvalidModel, match="vlad_core has the shape"):
        build(path)
    path.write_bytes(field(1, "nothing"))
    with pytest.raises(InvalidModel, match="conv1_1_v"):
        build(path)
