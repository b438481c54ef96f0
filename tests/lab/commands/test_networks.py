"""Networks that others published, from the file to the verdict: import, calibration, enrolment, query, evaluation.

Small networks with random weights, which take and give what the presets say, stand for the authors'.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from core.method.catalogue import EncoderCatalogue
from lab.conversion import onnx_import
from tests.lab.conversion.in_process import use
from tests.lab.conversion.onnx_writer import MAPS, onnx_network, published_network
from tests.service.commands.conftest import Placerec
from tests.service.scenes import encoded, scene, seen_again
from tests.service.server import Server


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pictures")
    for seed in range(30):
        (folder / f"{seed}.jpg").write_bytes(encoded(scene(seed, 96, 72)))
    return folder


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, onnx_import.__name__)


@pytest.mark.thorough
@pytest.mark.parametrize(("preset", "dimension"), [("salad", 6), ("anyloc", 32 * 6)])
def test_from_a_published_network_to_the_verdict(
    preset: str, dimension: int, placerec: Placerec, server: Server, pictures: Path, tmp_path: Path
) -> None:
    models, name = server.folder / "models", f"small-{preset}"
    (tmp_path / "small.onnx").write_bytes(published_network(preset, 112).SerializeToString())
    words = ("model", "import", tmp_path / "small.onnx", "--preset", preset, "--name", name)
    size = ("--input-size", 112, "--models-dir", models)
    learned = preset == "anyloc"
    made = placerec(*words, *size, *(("--images", pictures) if learned else ()))
    if not learned:
        assert f"placerec calibrate {name} --packaged" in made.stderr.replace("\n", " ")
        (summary,) = (one for one in EncoderCatalogue(models).describe() if one.name == name)
        assert summary.calibration is not None and summary.calibration.source == "not-measured"
        told = json.loads(placerec("calibrate", name, "--packaged", pictures, "--models-dir", models, "--json").stdout)
        assert told["stored"] and told["calibration"]["frames"] == 30
    (summary,) = (one for one in EncoderCatalogue(models).describe() if one.name == name)
    assert (summary.dimension, summary.damaged) == (dimension, None)
    assert summary.identity == made.stdout.split()[0]
    assert summary.calibration is not None and summary.calibration.source == "encoder-default"
    assert summary.calibration.geometry is not None

    server.create_map(name, encoder=name)
    for seed in range(4):
        response = server.enrol(name, f"p{seed}", encoded(scene(seed, 96, 72)), sequence="monday")
        assert response.status_code == 201, response.text
    answer = server.query(name, encoded(scene(2, 96, 72)), verify="always")
    assert answer["matches"][0]["place"]["id"] == "p2" and answer["encoder"] == summary.identity
    assert answer["score"] == pytest.approx(1.0, abs=0.01) or learned
    assert server.client.delete(f"/v1/maps/{name}").status_code == 204


@pytest.mark.thorough
def test_an_evaluation_and_a_second_stage(placerec: Placerec, pictures: Path, tmp_path: Path) -> None:
    models = ("--models-dir", tmp_path / "models")
    (tmp_path / "small.onnx").write_bytes(onnx_network().SerializeToString())
    described = MAPS.model_dump() | {
        "aggregation": {"method": "vlad", "words": 4, "whitening": 5},
        "second_stage": {"values": 4, "reach": [1, 1], "candidates": 5},
    }
    (tmp_path / "small.json").write_text(json.dumps(described))
    words = ("model", "import", tmp_path / "small.onnx", "--description", tmp_path / "small.json", "--name", "small")
    first = placerec(*words, *models)
    assert "placerec vocabulary train IMAGES" in first.stderr.replace("\n", " ") and not first.stdout
    trained = placerec("vocabulary", "train", pictures, "--network", "small", "--name", "small", *models)
    again = placerec(*words, *models, "--images", pictures, "--overwrite")
    assert trained.stdout.split()[0] == again.stdout.split()[0]

    queries = tmp_path / "queries"
    queries.mkdir()
    for seed in range(8):
        (queries / f"{seed}.jpg").write_bytes(encoded(seen_again(scene(seed, 96, 72), seed)))
    figures = tmp_path / "figures.json"
    traverses = ("--reference", pictures, "--query", queries, "--tolerance", 0)
    systems = [f"--encoder={name}" for name in ("small", "small.first-stage", "small.verified")]
    placerec("evaluate", *traverses, *systems, *models, "--json", figures)
    found = json.loads(figures.read_text())["encoders"]
    assert found[0]["encoder"] == again.stdout.split()[0]
    assert [one["encoder"].partition("@")[0] for one in found[1:]] == ["small.first-stage", "small.verified"]


def test_what_is_refused(placerec: Placerec, pictures: Path, tmp_path: Path) -> None:
    models = ("--models-dir", tmp_path / "models")
    file, checkpoint = tmp_path / "small.onnx", tmp_path / "small.pth"
    file.write_bytes(onnx_network().SerializeToString())
    torch.save({"w": torch.zeros(1)}, checkpoint)
    imported = ("model", "import", file, *models)
    placerec(*imported, "--name", "small", status=2)
    placerec(*imported, status=2)
    placerec(*imported, "--preset", "resnet", status=2)
    placerec(*imported, "--preset", "salad", "--description", file, status=2)
    placerec(*imported, "--preset", "salad", "--mean", file, status=2)
    fixed = placerec(*imported, "--preset", "salad", status=1)
    assert "not 1 x 3 x 322 x 322 as it is described" in fixed.stderr.replace("\n", " ")
    assert "322" in placerec(*imported, "--preset", "salad", "--input-size", 320, status=1).stderr.replace("320", "322")
    other = placerec("model", "import", checkpoint, "--preset", "salad", *models, status=1)
    assert "is a checkpoint: its authors' code has to export" in other.stderr.replace("\n", " ")
    few = placerec("calibrate", "m-region-vlad", "--packaged", pictures / "1.jpg", *models, status=1)
    assert "belongs to placerec" in few.stderr
    few = placerec("calibrate", "m-region-vlad", "--packaged", pictures / "1.jpg", "--dry-run", *models, status=1)
    assert "1 images are too few" in few.stderr
    placerec("calibrate", "small", "--packaged", pictures, "--itself", status=2)
    assert not list(tmp_path.glob("models/*"))
