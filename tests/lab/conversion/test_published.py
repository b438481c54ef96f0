"""Published networks: a small one of each layout is imported, and gives what torch gives.

The authors' weights are not at hand.  ``published_networks`` has networks of the same layouts and random weights.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from core.errors import InvalidModel
from core.networks.onnx_network import OnnxNetwork
from lab.conversion import checkpoints, onnx_import
from lab.conversion.layouts.checkpoints import LAYOUTS, build, export_checkpoint
from lab.conversion.onnx_import import import_onnx
from lab.conversion.published import PUBLISHED
from tests.lab.conversion.in_process import use
from tests.lab.conversion.published_networks import NETWORKS, SIZES, Boq, small_network

GOLDEN = 1e-4


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, checkpoints.__name__)
    use(monkeypatch, onnx_import.__name__)


def imported(folder: Path, network: nn.Module, preset: str, wrapper: str = "") -> OnnxNetwork:
    """The network of a checkpoint, as ``placerec model import`` makes it."""
    side = SIZES[preset]
    description = PUBLISHED[preset].at(side, side)
    state = {f"{wrapper}{name}": tensor for name, tensor in network.state_dict().items()}
    torch.save(state, folder / "checkpoint.pth")
    export_checkpoint(folder / "checkpoint.pth", preset, description, folder / "network.onnx")
    return OnnxNetwork(preset, import_onnx(folder / "network.onnx", description), description)


def test_every_preset_has_a_layout_and_a_citation() -> None:
    assert set(PUBLISHED) == set(LAYOUTS) == set(NETWORKS) == set(SIZES)
    assert all("20" in description.citation for description in PUBLISHED.values())


@pytest.mark.parametrize("preset", PUBLISHED)
def test_onnx_runtime_gives_what_torch_gives(preset: str, tmp_path: Path) -> None:
    network, side = small_network(preset), SIZES[preset]
    taken = imported(tmp_path, network, preset)
    images = torch.randn(2, 3, side, side, generator=torch.Generator().manual_seed(1))
    (found,) = taken(images)
    wanted = torch.cat([network(image[None]) for image in images])
    if preset == "anyloc":
        wanted = wanted.transpose(1, 2).reshape(2, -1, side // 14, side // 14)
    else:
        wanted = wanted[:, :, None, None]
        assert wanted.norm(dim=1) == pytest.approx(1.0, abs=1e-4)
    assert found.shape == wanted.shape
    assert (found - wanted).abs().max() < GOLDEN * wanted.abs().max()
    assert (found[0] - found[1]).abs().max() > 1e-5


def test_boq_on_a_resnet_and_a_checkpoint_within_another(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = Boq(residual=True).eval()
    taken = imported(tmp_path, network, "boq", wrapper="state_dict.module.")
    image = torch.randn(1, 3, 112, 112)
    with torch.inference_mode():
        assert (taken(image)[0].flatten() - network(image).flatten()).abs().max() < GOLDEN


def test_checkpoints_of_other_layouts_are_refused() -> None:
    description = PUBLISHED["megaloc"].at(112, 112)
    state = dict(small_network("megaloc").state_dict())

    def refused(message: str, changed: dict[str, torch.Tensor], preset: str = "megaloc") -> None:
        with pytest.raises(InvalidModel, match=message):
            build(preset, changed, description)

    refused("no backbone.model.pos_embed", {})
    refused("lacks backbone.model.norm.weight", {k: v for k, v in state.items() if k != "backbone.model.norm.weight"})
    refused("has further", state | {"further": torch.zeros(1)})
    refused("size mismatch", state | {"aggregator.linear.bias": torch.zeros(3)})
    refused("not finite", state | {"aggregator.linear.bias": torch.full((20,), torch.nan)})
    refused("is not that of DINOv2", state | {"backbone.model.pos_embed": torch.zeros(1, 80, 64)})
    refused("224x224 only", state, "cricavpr")
    refused("no backbone.model.conv1.weight", state, "mixvpr")
