"""The compact rivals on random weights of the published layouts, held to torch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from core.errors import InvalidModel
from core.method.catalogue import EncoderCatalogue
from core.networks.forward import GraphRunner
from lab.baselines.compact import (
    IMAGE,
    MOBILENET_BLOCKS,
    MOBILENET_STRIDES,
    SLOPE,
    CompactGem,
    generalized_mean,
    mobilenet_graph,
    squeezenet_graph,
)
from lab.baselines.registry import build

Arrays = dict[str, NDArray[np.float32]]
FRAMES = [
    np.kron(np.random.default_rng(seed).integers(0, 256, (6, 8, 3)), np.ones((20, 20, 1))).astype(np.uint8)
    for seed in range(6)
]


def drawn(generator: np.random.Generator, *shape: int) -> NDArray[np.float32]:
    """Filters that keep the size of what they see."""
    return generator.normal(0, np.sqrt(2 / np.prod(shape[1:])), shape).astype(np.float32)


def mobilenet(seed: int = 0) -> Arrays:
    generator, channels = np.random.default_rng(seed), 32
    arrays = {"conv1/W": drawn(generator, 32, 3, 3, 3), "conv1/b": np.full(32, 0.1, np.float32)}
    widths = (64, 128, 128, 256, 256, 512, 512, 512, 512, 512, 512, 1024)
    for block, width in zip(MOBILENET_BLOCKS, widths, strict=True):
        arrays[f"conv{block}_dw/W"] = drawn(generator, channels, 3, 3)
        arrays[f"conv{block}_sep/W"] = drawn(generator, width, channels, 1, 1)
        for part, count in (("dw", channels), ("sep", width)):
            arrays[f"conv{block}_{part}/b"] = generator.normal(0, 0.1, count).astype(np.float32)
        channels = width
    return arrays


def squeezenet(seed: int = 0) -> Arrays:
    generator = np.random.default_rng(seed)
    shapes = {"conv1": (64, 3, 3, 3)}
    channels = 64
    for number, narrow in zip(range(2, 10), (16, 16, 32, 32, 48, 48, 64, 64), strict=True):
        shapes[f"fire{number}/squeeze1x1"] = (narrow, channels, 1, 1)
        shapes[f"fire{number}/expand1x1"] = (4 * narrow, narrow, 1, 1)
        shapes[f"fire{number}/expand3x3"] = (4 * narrow, narrow, 3, 3)
        channels = 8 * narrow
    arrays = {}
    for name, shape in shapes.items():
        arrays[f"{name}/W"] = drawn(generator, *shape)
        for part, low, high in (("b", -0.1, 0.1), ("bn_beta", -0.1, 0.1), ("bn_gamma", 0.8, 1.2)):
            arrays[f"{name}/{part}"] = generator.uniform(low, high, shape[0]).astype(np.float32)
        arrays[f"{name}/bn_mean"] = generator.uniform(-0.1, 0.1, shape[0]).astype(np.float32)
        arrays[f"{name}/bn_inv_std"] = generator.uniform(0.8, 1.2, shape[0]).astype(np.float32)
    return arrays


def mobilenet_by_torch(arrays: Arrays, image: Tensor) -> Tensor:
    of = {name: torch.from_numpy(array) for name, array in arrays.items()}
    values = F.conv2d(image, of["conv1/W"], of["conv1/b"], 2, 1).relu()
    for block in MOBILENET_BLOCKS:
        name = f"conv{block}_dw"
        kernel = of[f"{name}/W"][:, None]
        values = F.conv2d(values, kernel, of[f"{name}/b"], MOBILENET_STRIDES.get(name, 1), 1, groups=len(kernel)).relu()
        values = F.conv2d(values, of[f"conv{block}_sep/W"], of[f"conv{block}_sep/b"]).relu()
    return values


def squeezenet_by_torch(arrays: Arrays, image: Tensor) -> Tensor:
    of = {name: torch.from_numpy(array) for name, array in arrays.items()}

    def layer(values: Tensor, name: str, stride: int = 1, pad: int = 0) -> Tensor:
        made = F.conv2d(values, of[f"{name}/W"].flip(2, 3), of[f"{name}/b"], stride, pad)
        shift, gain = (of[f"{name}/bn_{part}"][:, None, None] for part in ("mean", "inv_std"))
        beta, gamma = (of[f"{name}/bn_{part}"][:, None, None] for part in ("beta", "gamma"))
        return F.leaky_relu((made - shift) * gain * gamma + beta, SLOPE)

    values = F.max_pool2d(layer(image, "conv1", 2), 3, 2)
    for number in range(2, 10):
        squeezed = layer(values, f"fire{number}/squeeze1x1")
        wide = [layer(squeezed, f"fire{number}/expand{side}x{side}", pad=side // 2) for side in (1, 3)]
        values = torch.cat(wide, 1)
        if number in (3, 5):
            values = F.max_pool2d(values, 3, 2)
    return values


@pytest.mark.parametrize(
    ("arrays", "graph", "by_torch", "shape"),
    [
        (mobilenet(), mobilenet_graph, mobilenet_by_torch, (1024, 7, 7)),
        (squeezenet(), squeezenet_graph, squeezenet_by_torch, (512, 13, 13)),
    ],
)
def test_the_graphs_are_what_torch_computes(arrays, graph, by_torch, shape) -> None:  # type: ignore[no-untyped-def]
    image = np.random.default_rng(1).normal(0, 1, (1, 3, 224, 224)).astype(np.float32)
    found = GraphRunner("rival", graph(arrays))({IMAGE: image})[0][0]
    wanted = by_torch(arrays, torch.from_numpy(image))[0].numpy()
    assert found.shape == shape
    np.testing.assert_allclose(found, wanted, atol=1e-4 * float(np.abs(wanted).max()))


def test_the_generalized_mean_by_hand() -> None:
    maps = np.array([[[1, 2], [3, 0]], [[-1, -1], [-1, -1]]], np.float32)
    np.testing.assert_allclose(generalized_mean(maps), [(36 / 4) ** (1 / 3), 1e-6], rtol=1e-5)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("rivals")
    made = {"mobilenet-gem": mobilenet(), "squeezenet-gem": squeezenet()}
    for name, arrays in made.items():
        np.savez(folder / f"{name}.npz", **arrays)  # type: ignore[arg-type]
    return {name: folder / f"{name}.npz" for name in made}


@pytest.mark.thorough
def test_a_rival_learns_eight_bits_and_knows_its_frames(files: dict[str, Path]) -> None:
    name = "squeezenet-gem"
    system = build(name, models=EncoderCatalogue(), weights=files[name])
    assert isinstance(system, CompactGem)
    untrained = system.identity
    with pytest.raises(InvalidModel, match="train it on frames first"):
        system.describe(FRAMES[0])
    system.train((FRAMES[place % len(FRAMES)] for place in range(210)), seed=0)
    assert system.nbytes < 0.35 * files[name].stat().st_size
    assert system.identity != untrained and system.identity.startswith(f"{name}@")
    known = [system.describe(frame) for frame in FRAMES[:4]]
    asked = [system.describe(np.clip(frame.astype(int) + 6, 0, 255).astype(np.uint8)) for frame in FRAMES[:4]]
    scores = system.index(known).score(asked)
    assert scores.argmax(axis=1).tolist() == [0, 1, 2, 3]
    assert np.isfinite(system.index(known).score([system.describe(np.zeros((40, 50, 3), np.uint8))])).all()


def test_files_that_are_no_rival(files: dict[str, Path], tmp_path: Path) -> None:
    models = EncoderCatalogue()
    (tmp_path / "text.npz").write_bytes(b"no zip")
    np.savez(tmp_path / "objects.npz", a=np.array([{}], object))
    for name in ("text.npz", "objects.npz"):
        with pytest.raises(InvalidModel, match=r"not a readable .npz of plain arrays"):
            build("squeezenet-gem", models=models, weights=tmp_path / name)
    with pytest.raises(InvalidModel, match="no finite array conv1/bn_beta"):
        build("squeezenet-gem", models=models, weights=files["mobilenet-gem"])
    wrong = {**squeezenet(), "fire4/squeeze1x1/W": np.zeros((32, 5, 1, 1), np.float32)}
    np.savez(tmp_path / "wrong.npz", **wrong)  # type: ignore[arg-type]
    with pytest.raises(InvalidModel, match="cannot compute"):
        build("squeezenet-gem", models=models, weights=tmp_path / "wrong.npz")
    system = build("squeezenet-gem", models=models, weights=files["squeezenet-gem"])
    assert isinstance(system, CompactGem)
    with pytest.raises(InvalidModel, match="a training frame"):
        system.train([], seed=0)
