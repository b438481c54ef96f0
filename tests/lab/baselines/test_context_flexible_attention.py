"""Context Flexible Attention: its mask by hand, and files of its layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file

from core.errors import InvalidModel
from core.method.catalogue import EncoderCatalogue
from lab.baselines import registry
from lab.baselines.attention.context_flexible_attention import FlexibleContext
from lab.baselines.system import System
from tests.lab.baselines.test_fix_context import slid
from tests.lab.conversion.vgg_writer import blocks, plain_maps, plain_vgg

Array = NDArray[Any]
IMAGENET = (103.939, 116.779, 123.68)


def build(path: Path) -> System:
    return registry.build("context-flexible-attention", models=EncoderCatalogue(), weights=path)


def vector(system: System, frame: NDArray[np.uint8]) -> Array:
    return np.asarray(system.describe(frame).arrays["descriptor"])


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


@pytest.mark.thorough
def test_context_flexible_attention_of_a_file(tmp_path: Path) -> None:
    frame = blocks(224, 224)
    tensors = flexible()
    system = build(write(tmp_path / "a.safetensors", tensors))
    found = vector(system, frame)
    maps = plain_maps(frame, IMAGENET).astype(np.float64)
    mask = flexible_mask(maps, tensors)
    wanted = (maps * mask).reshape(-1)
    assert found.shape == (3 * 14 * 14,) and mask.std() > 0.1
    np.testing.assert_allclose(found, wanted / np.linalg.norm(wanted), atol=1e-5)
    torch.save({name: torch.from_numpy(tensor) for name, tensor in tensors.items()}, tmp_path / "a.pth")
    again = build(tmp_path / "a.pth")
    assert again.identity == system.identity
    np.testing.assert_allclose(vector(again, frame), found, atol=1e-6)


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
        build(write(tmp_path / "a.safetensors", tensors))


def test_a_blank_frame_has_a_description(tmp_path: Path) -> None:
    system = build(write(tmp_path / "a.safetensors", flexible()))
    blank = system.describe(np.zeros((30, 40, 3), np.uint8))
    assert not np.asarray(blank.arrays["descriptor"]).any()
    assert system.index([blank]).score([blank]).tolist() == [[0]]
