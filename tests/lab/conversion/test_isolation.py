"""Reading in a child process: whatever happens to it, the parent gets contents or one kind of error."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import savemat

from core.errors import InvalidModel
from lab.conversion import isolation
from lab.conversion.caffemodel import read_caffemodel
from lab.conversion.checkpoints import read_checkpoint
from lab.conversion.isolation import Contents, read_in_child
from lab.conversion.matfiles import read_mat
from lab.conversion.onnx_import import import_onnx
from tests.lab.conversion.caffe_writer import HEAD, caffemodel, small_network
from tests.lab.conversion.onnx_writer import MAPS, onnx_network

MISBEHAVING = "tests.lab.conversion.misbehaving"


def read(path: Path, text: str) -> Contents:
    (path / "file").write_text(text)
    return read_in_child(MISBEHAVING, path / "file", framework="numpy")


def test_what_the_child_found_comes_back(tmp_path: Path) -> None:
    found = read(tmp_path, "hello")
    assert found.tree == {"text": "hello"} and list(found) == ["numbers"] and len(found) == 1
    assert found["numbers"].tolist() == [0, 1, 2]
    with pytest.raises(KeyError):
        found["others"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("lie", r"file cannot be used: The file lies\.$"),
        ("stumble", r"file cannot be used: it is damaged: ZeroDivisionError: by nothing"),
        ("crash", "file cannot be used: it is damaged, or reading it takes too much"),
        ("memory", "file cannot be used: it is damaged, or reading it takes too much"),
        ("leave", "file cannot be used: it is damaged, or reading it takes too much"),
    ],
)
def test_what_the_child_does_becomes_one_kind_of_error(tmp_path: Path, what: str, message: str) -> None:
    with pytest.raises(InvalidModel, match=message):
        read(tmp_path, what)


@pytest.mark.thorough
def test_a_child_that_does_not_end_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolation, "SECONDS", 2)
    with pytest.raises(InvalidModel, match="takes too long"):
        read(tmp_path, "hang")


def test_files_that_are_not_read_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, message in ((".", "there is no such file"), ("none", "there is no such file"), ("empty", "0 bytes")):
        (tmp_path / "empty").touch()
        with pytest.raises(InvalidModel, match=message):
            read_in_child(MISBEHAVING, tmp_path / name, framework="numpy")
    monkeypatch.setattr(isolation, "MAX_FILE", 3)
    with pytest.raises(InvalidModel, match="file has 5 bytes; from 1 to 3 are read"):
        read(tmp_path, "hello")


def test_the_child_imports_nothing_from_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit('taken over')")
    monkeypatch.chdir(tmp_path)
    assert read(tmp_path, "hello").tree == {"text": "hello"}


# Damaged files, each read in a fork


def write_mats(folder: Path) -> list[Path]:
    layers = np.empty((1, 2), object)
    layers[0, :] = {"type": "conv", "weights": np.arange(60, dtype=np.float32).reshape(3, 4, 5)}, {"type": "relu"}
    for name, compressed in (("plain.mat", False), ("compressed.mat", True)):
        savemat(folder / name, {"net": {"layers": layers, "name": "x"}, "more": 3.0}, do_compression=compressed)
    return [folder / "plain.mat", folder / "compressed.mat"]


def write_checkpoints(folder: Path) -> list[Path]:
    state = {"state_dict": {"a": torch.rand(3, 4)}, "epoch": 3, "part": torch.arange(24.0).reshape(2, 3, 4)[:, 1:]}
    for name, zipped in (("new.pth", True), ("old.pth", False)):
        torch.save(state, folder / name, _use_new_zipfile_serialization=zipped)
    return [folder / "new.pth", folder / "old.pth"]


def write_caffemodels(folder: Path) -> list[Path]:
    for generation in ("new", "old"):
        (folder / generation).write_bytes(caffemodel(small_network() + HEAD, generation))
    return [folder / "new", folder / "old"]


def write_onnx(folder: Path) -> list[Path]:
    (folder / "sound.onnx").write_bytes(onnx_network().SerializeToString())
    return [folder / "sound.onnx"]


def read_onnx(path: Path) -> bytes:
    return import_onnx(path, MAPS)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("reader", "count", "write", "read_it"),
    [
        (f"lab.conversion.onnx_import:{MAPS.model_dump_json()}", 40, write_onnx, read_onnx),
        ("lab.conversion.matfiles", 150, write_mats, read_mat),
        ("lab.conversion.checkpoints", 40, write_checkpoints, read_checkpoint),
        ("lab.conversion.caffemodel:network", 60, write_caffemodels, read_caffemodel),
    ],
)
def test_damaged_files_harm_nobody(
    tmp_path: Path, reader: str, count: int, write: Callable[[Path], list[Path]], read_it: Callable[[Path], object]
) -> None:
    """A file that ends the library's process, or takes all its memory, is refused as any other damaged file."""
    sound = write(tmp_path)
    assert all(read_it(path) for path in sound[:1])
    command = [
        sys.executable,
        "-m",
        "tests.lab.conversion.hostile",
        reader,
        str(count),
        str(tmp_path),
        *map(str, sound),
    ]
    done = subprocess.run(command, capture_output=True, check=True, timeout=300)
    ends = json.loads(done.stdout.splitlines()[-1])
    assert sum(ends.values()) == count and min(ends["read"], ends["refused"]) > 0, ends
    for bad in sorted(tmp_path.glob("*.bad")):
        with pytest.raises(InvalidModel, match=bad.name):
            read_it(bad)
