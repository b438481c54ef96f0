"""``placerec model import``: from a Caffe network to one that vocabularies are trained for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from core.method.catalogue import EncoderCatalogue
from core.networks.network import read_definition
from core.networks.torch_network import load_torch_network
from tests.lab.conversion.caffe_writer import caffemodel, input_dim, small_network
from tests.service.commands.conftest import Placerec
from tests.service.scenes import encoded, scene


@pytest.fixture
def caffe_files(tmp_path: Path) -> tuple[Path, Path]:
    model, mean = tmp_path / "small.caffemodel", tmp_path / "mean.npy"
    model.write_bytes(caffemodel(small_network(), start=input_dim(1, 3, 96, 128)))
    np.save(mean, np.array([104.0, 117.0, 123.0]))
    return model, mean


@pytest.mark.thorough
def test_a_caffe_network_is_imported_and_used(
    placerec: Placerec, caffe_files: tuple[Path, Path], tmp_path: Path
) -> None:
    model, mean = caffe_files
    models = ("--models-dir", tmp_path / "models")
    shown = placerec("model", "import", model, "--mean", mean, "--name", "small-net", *models)
    assert "input 128x96, mean 104, 117, 123" in shown.stdout
    assert "channels=12" in shown.stdout
    path = tmp_path / "models" / "small-net.network.safetensors"
    assert str(path) in shown.stderr.replace("\n", "")
    network = load_torch_network(path, ["conv3"])
    weight = small_network()[8]["blobs"][0]
    np.testing.assert_array_equal(network.weights()["conv3.weight"], weight)

    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for seed in range(30):
        (pictures / f"{seed}.jpg").write_bytes(encoded(scene(seed, 128, 96)))
    train = ("vocabulary", "train", pictures, "--network", "small-net", "--name", "mine", "--layers", "conv3")
    placerec(*train, "--regions", 20, "--words", 4, "--step", 0.05, *models)
    encoder = EncoderCatalogue(tmp_path / "models").get("mine")
    assert encoder.dimension == 4 * 10
    assert len(encoder.encode(scene(0)).regions) > 0


def test_another_input_size(placerec: Placerec, caffe_files: tuple[Path, Path], tmp_path: Path) -> None:
    model, mean = caffe_files
    imported = ("model", "import", model, "--mean", mean, "--models-dir", tmp_path)
    placerec(*imported, "--name", "wide", "--input-size", "160x120")
    shown = read_definition(tmp_path / "wide.network.safetensors").input
    assert (shown.width, shown.height) == (160, 120)
    placerec(*imported, "--name", "square", "--input-size", "100")
    shown = read_definition(tmp_path / "square.network.safetensors").input
    assert (shown.width, shown.height) == (100, 100)
    placerec(*imported, "--name", "odd", "--input-size", "wide", status=2)


@pytest.mark.thorough
def test_what_is_refused(placerec: Placerec, caffe_files: tuple[Path, Path], tmp_path: Path) -> None:
    model, mean = caffe_files
    models = ("--models-dir", tmp_path)
    assert "mean" in placerec("model", "import", model, "--name", "small", *models, status=1).stderr
    assert "damaged" in placerec("model", "import", mean, "--name", "small", *models, status=1).stderr
    missing = placerec("model", "import", tmp_path / "none.caffemodel", "--name", "small", *models, status=1)
    assert "cannot be read" in missing.stderr
    taken = placerec("model", "import", model, "--mean", mean, "--name", "placerec-hybrid", *models, status=1)
    assert "packaged network" in taken.stderr
    placerec("model", "import", model, "--mean", mean, "--name", "small", *models)
    again = placerec("model", "import", model, "--mean", mean, "--name", "small", *models, status=1)
    assert "--overwrite" in again.stderr
    placerec("model", "import", model, "--mean", mean, "--name", "small", *models, "--overwrite")
