"""``placerec vocabulary train``: an encoder of one's own, from pictures to a map that uses it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from core.method.catalogue import PACKAGED, EncoderCatalogue
from tests.service.commands.conftest import Placerec
from tests.service.scenes import encoded, scene

SMALL = ("--layers", "conv3", "--regions", 40, "--words", 8, "--step", "0.1")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    (folder / "more").mkdir()
    for seed in range(34):
        (folder / ("more" if seed % 3 else "") / f"{seed}.jpg").write_bytes(encoded(scene(seed, 96, 72)))
    return folder


@pytest.mark.thorough
def test_the_same_seed_makes_the_same_encoder(placerec: Placerec, pictures: Path, tmp_path: Path) -> None:
    train = ("vocabulary", "train", pictures, "--name", "mine", *SMALL)
    for folder in ("a", "b"):
        placerec(*train, "--models-dir", tmp_path / folder)
    placerec(*train, "--models-dir", tmp_path / "c", "--seed", 1)

    encoders = [EncoderCatalogue(tmp_path / folder).get("mine") for folder in "abc"]
    assert encoders[0].identity == encoders[1].identity
    assert encoders[0].identity != encoders[2].identity
    np.testing.assert_array_equal(encoders[0].centers, encoders[1].centers)
    assert encoders[0].centers.shape == (8, 384)
    definition = encoders[0].definition
    assert (definition.layers, definition.regions, definition.steps) == (("conv3",), 40, (0.1,))
    assert definition.unit_features
    encoders[0].check_golden()
    assert encoders[0].calibration.source == "encoder-default"
    assert encoders[0].calibration.background_deviation > 0
    (summary,) = (one for one in EncoderCatalogue(tmp_path / "a").describe() if one.name == "mine")
    assert summary.training["images"] == 28
    assert summary.training["held_out"] == 6
    assert summary.training["seed"] == 0


@pytest.mark.thorough
def test_options_reach_the_definition_and_a_map_uses_it(
    placerec: Placerec, pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLACEREC_MODELS_DIR", str(tmp_path / "models"))
    network = tmp_path / "elsewhere" / "own.network.safetensors"
    network.parent.mkdir()
    network.write_bytes((PACKAGED / "placerec-hybrid.network.safetensors").read_bytes())
    (pictures / "broken.jpg").write_bytes(b"broken")
    made = placerec(
        *("vocabulary", "train", pictures, "--network", network, "--name", "raw", "--layers", "conv3,conv4"),
        *("--regions", 30, "--words", 4, "--step", "0.1,0.2", "--raw", "--gamma", 0.7, "--normalization", "global"),
    )
    (pictures / "broken.jpg").unlink()
    assert made.stdout.startswith("raw@")
    assert "broken.jpg is left out" in made.stderr
    definition = EncoderCatalogue(tmp_path / "models").get("raw").definition
    assert definition.model_dump(exclude_none=True) == {
        "layers": ("conv3", "conv4"),
        "regions": 30,
        "steps": (0.1, 0.2),
        "unit_features": False,
        "least_contrast": 2.0,
        "words": 4,
        "gamma": 0.7,
        "normalization": "global",
    }

    placerec("maps", "create", "lab", "--encoder", "raw")
    folder = tmp_path / "traverse"
    folder.mkdir()
    for seed in range(3):
        (folder / f"{seed}.jpg").write_bytes(encoded(scene(seed)))
    placerec("enrol", folder, "--map", "lab")
    answer = json.loads(placerec("query", folder / "1.jpg", "-m", "lab", "--json").stdout)
    assert answer["matches"][0]["place"]["id"] == "1"
    assert answer["score"] == pytest.approx(1.0, abs=1e-4)
    assert answer["encoder"].startswith("raw@")


@pytest.mark.thorough
def test_names_are_guarded(placerec: Placerec, pictures: Path, tmp_path: Path) -> None:
    models = ("--models-dir", tmp_path)
    taken = placerec("vocabulary", "train", pictures, "--name", "m-region-vlad", *models, status=1)
    assert "is the name of a packaged encoder" in taken.stderr
    odd = placerec("vocabulary", "train", pictures, "--name", "My Encoder", *models, status=1)
    assert "cannot name an encoder" in odd.stderr
    placerec("vocabulary", "train", pictures, "--name", "mine", *SMALL, *models)
    before = EncoderCatalogue(tmp_path).resolve("mine")
    again = placerec("vocabulary", "train", pictures, "--name", "mine", *SMALL, *models, "--seed", 5, status=1)
    assert "--overwrite" in again.stderr
    assert EncoderCatalogue(tmp_path).resolve("mine") == before
    placerec("vocabulary", "train", pictures, "--name", "mine", *SMALL, *models, "--seed", 5, "--overwrite")
    assert EncoderCatalogue(tmp_path).resolve("mine") != before


def test_what_is_refused(placerec: Placerec, pictures: Path, tmp_path: Path) -> None:
    train = ("vocabulary", "train", pictures, "--name", "mine", "--models-dir", tmp_path)
    assert "no convolution or pooling named conv9" in placerec(*train, "--layers", "conv9", status=1).stderr
    assert "no network named 'hybridnet'" in placerec(*train, "--network", "hybridnet", status=1).stderr
    placerec(*train, "--step", "small", status=2)
    assert "one positive quantisation step" in placerec(*train, "--step", "1,2,3", status=1).stderr
    blind = placerec(*train, *SMALL[:-1], "1e9", status=1)
    assert "no frame has a region of interest" in blind.stderr
    few = placerec("vocabulary", "train", pictures / "0.jpg", "--name", "mine", "--models-dir", tmp_path, status=1)
    assert "1 images are too few" in few.stderr
    none = placerec("vocabulary", "train", tmp_path, "--name", "mine", "--models-dir", tmp_path, status=1)
    assert "is no image and holds none" in none.stderr
    assert not list(tmp_path.glob("*.safetensors"))
