"""Arrays and mean files of Caffe."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.errors import InvalidModel
from lab.conversion.caffemodel import read_caffemodel, read_mean
from tests.lab.conversion import in_process

IMAGE = np.random.default_rng(1).uniform(0, 255, (3, 20, 30)).astype(np.float32)


def binaryproto(image: NDArray[np.float32]) -> bytes:
    """A BlobProto: num 1, the three sides, packed floats."""
    content = image.tobytes()
    assert max(image.shape) < 128
    assert 2**7 <= len(content) < 2**14
    channels, height, width = image.shape
    length = [len(content) & 0x7F | 0x80, len(content) >> 7]
    return bytes([0x08, 1, 0x10, channels, 0x18, height, 0x20, width, 0x2A, *length]) + content


@pytest.mark.parametrize("image", [IMAGE, IMAGE[np.newaxis], IMAGE.astype(np.float64), IMAGE.astype(np.uint8)])
def test_a_mean_image_becomes_the_mean_of_each_channel(tmp_path: Path, image: Any) -> None:
    np.save(tmp_path / "mean.npy", image)
    wanted = image.reshape(3, -1).mean(axis=1, dtype=np.float64)
    np.testing.assert_allclose(read_mean(tmp_path / "mean.npy"), wanted, rtol=1e-12)


def test_three_numbers_are_the_mean(tmp_path: Path) -> None:
    np.save(tmp_path / "mean.NPY.npy", np.array([104.0, 117.5, 123.25]))
    assert read_mean(tmp_path / "mean.NPY.npy") == (104.0, 117.5, 123.25)


def test_a_binaryproto(tmp_path: Path) -> None:
    (tmp_path / "mean.binaryproto").write_bytes(binaryproto(IMAGE))
    wanted = IMAGE.mean(axis=(1, 2), dtype=np.float64)
    np.testing.assert_allclose(read_mean(tmp_path / "mean.binaryproto"), wanted, rtol=1e-12)


@pytest.mark.parametrize(
    "image",
    [
        np.ones(2),
        np.ones((4, 5, 5)),
        np.full(3, np.nan),
        np.array(["a", "b", "c"]),
        np.ones((3, 0, 5)),
        np.ones(()),
        np.array([{}, {}, {}], dtype=object),
    ],
)
def test_a_mean_of_another_kind_is_refused(tmp_path: Path, image: Any) -> None:
    np.save(tmp_path / "mean.npy", image)
    with pytest.raises(InvalidModel, match=r"mean\.npy"):
        read_mean(tmp_path / "mean.npy")


def test_a_header_that_announces_more_than_there_is_allocates_nothing(tmp_path: Path) -> None:
    np.save(tmp_path / "mean.npy", np.ones((3, 10, 10)))
    content = (tmp_path / "mean.npy").read_bytes().replace(b"(3, 10, 10)", b"(3, 9999999999)")
    (tmp_path / "mean.npy").write_bytes(content)
    (tmp_path / "mean.binaryproto").write_bytes(binaryproto(IMAGE).replace(b"\x18\x14", b"\x18\x7f"))
    for name in ("mean.npy", "mean.binaryproto"):
        with pytest.raises(InvalidModel, match=name):
            read_mean(tmp_path / name)


@pytest.mark.parametrize("name", ["missing.npy", "missing.binaryproto", "empty.npy", "empty.binaryproto", "folder.npy"])
def test_files_that_cannot_be_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty.npy").touch()
    (tmp_path / "empty.binaryproto").touch()
    (tmp_path / "folder.npy").mkdir()
    with pytest.raises(InvalidModel, match=name):
        read_mean(tmp_path / name)


NPY_HEADER = b"\x93NUMPY\x01\0\x76\0{'descr': '<f4', 'fortran_order': False, 'shape': (3, 2, 2), }".ljust(127) + b"\n"
WHOLE = {"mean.npy": NPY_HEADER + bytes(48), "mean.binaryproto": binaryproto(IMAGE)}


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(sorted(WHOLE)), st.integers(0, 140), st.integers(0, 3), st.binary(max_size=4))
def test_a_mutated_mean_file_is_refused_or_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, place: int, removed: int, added: bytes
) -> None:
    in_process.use(monkeypatch, "lab.conversion.caffemodel")
    content = WHOLE[name]
    (tmp_path / name).write_bytes(content[:place] + added + content[place + removed :])
    try:
        mean = read_mean(tmp_path / name)
    except InvalidModel:
        return
    assert np.isfinite(mean).all()


def test_the_file_that_is_mutated_above_is_whole(tmp_path: Path) -> None:
    (tmp_path / "mean.npy").write_bytes(WHOLE["mean.npy"])
    assert read_mean(tmp_path / "mean.npy") == (0.0, 0.0, 0.0)


def test_a_model_without_layers_is_read_as_such(tmp_path: Path) -> None:
    (tmp_path / "net.caffemodel").write_bytes(b"\x0a\x05small")
    network = read_caffemodel(tmp_path / "net.caffemodel")
    assert (network.input, network.input_shape, network.layers) == (None, (), ())
