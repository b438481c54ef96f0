"""Presets of published networks, as their files in the ONNX format use them.

The authors' weights are not at hand.  Each preset gets a small network that takes and gives what its own does.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.networks.onnx_network import OnnxNetwork
from lab.conversion import onnx_import
from lab.conversion.onnx_import import import_onnx
from lab.conversion.presets import PRESETS
from tests.lab.conversion.in_process import use
from tests.lab.conversion.onnx_writer import published_network


@pytest.mark.parametrize("preset", PRESETS)
def test_a_network_that_takes_and_gives_what_the_preset_says(
    preset: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    use(monkeypatch, onnx_import.__name__)
    description = PRESETS[preset]
    side = description.input.height
    (tmp_path / "network.onnx").write_bytes(published_network(preset).SerializeToString())
    network = OnnxNetwork(preset, import_onnx(tmp_path / "network.onnx", description), description)
    (found,) = network(np.random.default_rng(1).standard_normal((2, side, side, 3), np.float32))
    cells = (side // 14, side // 14) if description.output.kind == "tokens" else (1, 1)
    assert found.shape == (2, *cells, 6)
    assert np.abs(found[0] - found[1]).max() > 1e-5


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_normalize_as_imagenet_and_name_who_made_the_network(preset: str) -> None:
    description = PRESETS[preset]
    white = (255 - np.array(description.input.mean)) * np.array(description.input.scale)
    assert white == pytest.approx([2.2489, 2.4286, 2.6400], abs=1e-3)
    assert description.input.channel_order == "rgb" and "20" in description.citation
    assert description.input.height == description.input.width
