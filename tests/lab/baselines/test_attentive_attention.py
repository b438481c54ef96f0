"""Attentive Attention: its weights by hand, and a checkpoint of the port."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from core.errors import InvalidModel
from core.method.catalogue import EncoderCatalogue
from lab.baselines import registry
from lab.baselines.attention.attentive_attention import Attention
from lab.baselines.system import System
from lab.conversion import checkpoints
from tests.lab.baselines.trunks.test_resnet import small_resnet
from tests.lab.conversion import in_process

Array = NDArray[Any]


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    in_process.use(monkeypatch, checkpoints.__name__)


def build(path: Path) -> System:
    return registry.build("attentive-attention", models=EncoderCatalogue(), weights=path)


def vector(system: System, frame: NDArray[np.uint8]) -> Array:
    return np.asarray(system.describe(frame).arrays["descriptor"])


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
    frame = np.random.default_rng(0).integers(0, 256, (224, 224, 3), np.uint8)
    system = build(path)
    found = vector(system, frame)

    with torch.inference_mode():
        maps = base(torch.from_numpy(frame[:, :, ::-1].copy()).permute(2, 0, 1)[None] / 255)
        alpha = nn.functional.softplus(conv2(conv1(maps).relu()))[0, 0].numpy()
    summed = np.zeros(9)
    for y, x in np.ndindex(14, 14):
        feature = maps[0, :, y, x].numpy()
        summed += alpha[y, x] * feature / np.linalg.norm(feature)
    np.testing.assert_allclose(found, summed / np.linalg.norm(summed), atol=1e-5)
    assert system.index([system.describe(frame)]).score([system.describe(frame)])[0, 0] == pytest.approx(1)


def test_a_checkpoint_without_attention(tmp_path: Path) -> None:
    path = tmp_path / "a.pth"
    torch.save({"base": small_resnet().state_dict()}, path)
    with pytest.raises(InvalidModel, match=r"a\.pth has no DELF network with attention: it has no conv1\.weight"):
        build(path)
    torch.save({"base": small_resnet().state_dict(), "attn": {"conv1.weight": torch.rand(6, 8, 1, 1)}}, path)
    with pytest.raises(InvalidModel, match=r"it has no conv1\.bias"):
        build(path)
