"""The catalogue of installed encoders: found, loaded, refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

from core.errors import InvalidModel, UnknownEncoder
from core.method.catalogue import DEFAULT_ENCODER, PACKAGED, EncoderCatalogue, save_calibration, save_encoder
from core.method.encoder import Encoder
from core.method.presets import NETWORK, PRESETS
from core.method.vocabulary import Vocabulary
from core.networks.xfeat import PACKAGED_XFEAT


@pytest.fixture(scope="module")
def packaged() -> Encoder:
    return EncoderCatalogue().get(DEFAULT_ENCODER)


def install(folder: Path, packaged: Encoder, name: str) -> Path:
    """A second encoder on the packaged network, with its words in another order."""
    vocabulary = Vocabulary(packaged.centers[::-1].copy(), packaged.extractor.origin)
    encoder = Encoder(name, packaged.extractor, packaged.definition, vocabulary, packaged.calibration)
    return save_encoder(folder, encoder, vocabulary, NETWORK, {"images": 1})


def test_the_packaged_encoders_are_the_presets() -> None:
    summaries = {summary.name: summary for summary in EncoderCatalogue().describe()}
    assert set(summaries) == set(PRESETS)
    for name, definition in PRESETS.items():
        assert summaries[name].definition == definition
        assert summaries[name].damaged is None
        assert summaries[name].default == (name == DEFAULT_ENCODER)
    assert summaries[DEFAULT_ENCODER].dimension == 128 * 128  # words, values of a projected feature


def test_the_packaged_files_are_small() -> None:
    assert PACKAGED_XFEAT.stat().st_size < 3_000_000
    assert sum(path.stat().st_size for path in PACKAGED.rglob("*.safetensors")) < 10_000_000  # encoders, their network


def test_names_and_identities_resolve(packaged: Encoder) -> None:
    catalogue = EncoderCatalogue()
    assert catalogue.resolve(DEFAULT_ENCODER) == packaged.identity == catalogue.resolve(packaged.identity)
    assert catalogue.get(DEFAULT_ENCODER) is catalogue.get(packaged.identity)


def test_an_unknown_name_lists_what_there_is() -> None:
    with pytest.raises(UnknownEncoder, match="m-region-vlad"):
        EncoderCatalogue().resolve("netvlad")


def test_an_old_identity_is_refused_with_the_way_out() -> None:
    with pytest.raises(UnknownEncoder, match="Re-encode"):
        EncoderCatalogue().get("m-region-vlad@" + "0" * 64)


def test_an_installed_encoder_round_trips(tmp_path: Path, packaged: Encoder) -> None:
    install(tmp_path, packaged, "turned")
    catalogue = EncoderCatalogue(tmp_path)
    loaded = catalogue.get("turned")
    assert loaded.identity == catalogue.resolve("turned")
    np.testing.assert_array_equal(loaded.centers, packaged.centers[::-1])
    loaded.check_golden()
    assert [s.source for s in catalogue.describe() if s.name == "turned"] == ["installed"]


def test_an_installed_encoder_cannot_take_a_packaged_name(tmp_path: Path, packaged: Encoder) -> None:
    install(tmp_path, packaged, DEFAULT_ENCODER)
    assert EncoderCatalogue(tmp_path).resolve(DEFAULT_ENCODER) == packaged.identity


def test_a_damaged_file_is_named_and_harms_no_other(tmp_path: Path, packaged: Encoder) -> None:
    path = install(tmp_path, packaged, "torn")
    path.write_bytes(path.read_bytes()[:200])
    catalogue = EncoderCatalogue(tmp_path)
    damaged = {summary.name: summary.damaged for summary in catalogue.describe()}
    assert "torn.encoder.safetensors" in (damaged["torn"] or "")
    assert damaged[DEFAULT_ENCODER] is None
    with pytest.raises(InvalidModel, match="torn"):
        catalogue.get("torn")


def test_changed_contents_do_not_keep_the_identity(tmp_path: Path, packaged: Encoder) -> None:
    path = install(tmp_path, packaged, "forged")
    data = bytearray(path.read_bytes())
    data[-5] ^= 0x40  # in the tensors: the words or the golden values
    data[-150_000] ^= 0x40
    path.write_bytes(data)
    with pytest.raises(InvalidModel):
        EncoderCatalogue(tmp_path).get("forged")


def test_a_projection_that_is_missing_or_damaged_is_named(tmp_path: Path, packaged: Encoder) -> None:
    path = install(tmp_path, packaged, "skewed")
    with safe_open(path, "np") as file:
        tensors, metadata = {name: file.get_tensor(name) for name in file.keys()}, file.metadata()  # noqa: SIM118
    without = {name: tensor for name, tensor in tensors.items() if not name.startswith("projection.conv4")}
    not_finite = tensors | {"projection.conv3.mean": np.full(384, np.nan, np.float32)}
    no_mean = {name: tensor for name, tensor in tensors.items() if name != "projection.pool2.mean"}
    for damaged, said in ((without, "projection of conv4"), (not_finite, "of conv3"), (no_mean, "of pool2")):
        save_file(damaged, path, metadata)
        with pytest.raises(InvalidModel, match=said):
            EncoderCatalogue(tmp_path).get("skewed")


def test_another_kind_of_safetensors_is_refused(tmp_path: Path) -> None:
    save_file({"centers": np.zeros((2, 2), np.float32)}, tmp_path / "odd.encoder.safetensors")
    with pytest.raises(InvalidModel, match="not a placerec-encoder"):
        EncoderCatalogue(tmp_path).get("odd")


def test_a_missing_network_names_its_file(tmp_path: Path, packaged: Encoder) -> None:
    vocabulary = Vocabulary(packaged.centers, packaged.extractor.origin)
    encoder = Encoder("far", packaged.extractor, packaged.definition, vocabulary, packaged.calibration)
    save_encoder(tmp_path, encoder, vocabulary, "elsewhere", {})
    with pytest.raises(InvalidModel, match=r"elsewhere\.network\.safetensors"):
        EncoderCatalogue(tmp_path).get("far")


def test_a_renamed_file_is_refused(tmp_path: Path, packaged: Encoder) -> None:
    path = install(tmp_path, packaged, "first")
    shutil.move(path, tmp_path / "second.encoder.safetensors")
    with pytest.raises(InvalidModel, match="named as its encoder"):
        EncoderCatalogue(tmp_path).get("second")


def test_another_calibration_changes_nothing_else_of_a_file(tmp_path: Path, packaged: Encoder) -> None:
    path = install(tmp_path, packaged, "mine")
    before = EncoderCatalogue(tmp_path).get("mine")
    calibration = packaged.calibration.model_copy(update={"threshold": 0.5, "frames": 7})
    save_calibration(path, calibration)
    after = EncoderCatalogue(tmp_path).get("mine")
    assert after.calibration == calibration
    assert after.identity == before.identity
    after.check_golden()
    (tmp_path / "broken.encoder.safetensors").write_bytes(b"nothing")
    with pytest.raises(InvalidModel):
        save_calibration(tmp_path / "broken.encoder.safetensors", calibration)


def test_the_packaged_encoders_tell_probabilities() -> None:
    for summary in EncoderCatalogue().describe():
        assert summary.calibration is not None and summary.calibration.curve is not None
        assert summary.calibration.decision == "leading"
        # At the threshold an answer is about as likely right as wrong, and far above it nearly certain.
        assert 0.2 < summary.calibration.curve.probability(summary.calibration.threshold) < 0.8
        assert summary.calibration.curve.probability(4 * summary.calibration.threshold) > 0.95
