"""MATLAB files that SciPy wrote, and some that nobody should be able to break the process with."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat
from scipy.io.matlab import MatlabObject

from core.errors import InvalidModel
from lab.conversion import isolation
from lab.conversion.matfiles import Unreadable, is_mat, numbers, read_mat


def cell(*values: Any) -> np.ndarray[Any, Any]:
    row = np.empty((1, len(values)), object)
    row[0, :] = values
    return row


@pytest.mark.thorough
@pytest.mark.parametrize("compressed", [False, True])
def test_plain_values(tmp_path: Path, compressed: bool) -> None:
    weight = np.arange(24, dtype=np.float32).reshape(2, 3, 4)  # of 2 x 3 x 4 x 1: MATLAB drops the last side
    net = {
        "layers": cell({"type": "conv", "weights": cell(weight, np.ones((1, 4)))}, {"type": "relu"}),
        "empty": "",
        "none": {},
    }
    savemat(tmp_path / "a.mat", {"net": net, "number": 3.0, "one": cell({"x": "y"})}, do_compression=compressed)
    found = read_mat(tmp_path / "a.mat")
    assert sorted(found) == ["net", "number", "one"]
    assert found["number"].tolist() == [[3.0]]
    assert found["one"] == [{"x": "y"}]
    conv, relu = found["net"]["layers"]
    assert (conv["type"], relu, found["net"]["empty"], found["net"]["none"]) == ("conv", {"type": "relu"}, "", {})
    np.testing.assert_array_equal(conv["weights"][0], weight)
    np.testing.assert_array_equal(numbers(conv["weights"][0], "w", 2, 3, None, 1), weight[..., None])
    np.testing.assert_array_equal(numbers(conv["weights"][1], "b", 1, 4), np.ones((1, 4)))
    assert is_mat(tmp_path / "a.mat") and not is_mat(tmp_path / "b.mat")


@pytest.mark.thorough
def test_objects_of_matlab_are_named_not_read(tmp_path: Path) -> None:
    inside = np.zeros((1, 1), [("K", object)])
    inside[0, 0]["K"] = np.array([[64.0]])
    savemat(tmp_path / "a.mat", {"layers": cell(MatlabObject(inside, "layerVLAD"))})
    assert read_mat(tmp_path / "a.mat")["layers"] == [Unreadable("layerVLAD")]


def test_the_format_7_3_is_named_with_the_remedy(tmp_path: Path) -> None:
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM"
    (tmp_path / "new.mat").write_bytes(header.ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n")
    assert is_mat(tmp_path / "new.mat")
    with pytest.raises(InvalidModel, match=r"new\.mat is of MATLAB's 7\.3 format \(HDF5\); save it .* '-v7'"):
        read_mat(tmp_path / "new.mat")


@pytest.mark.parametrize(
    ("value", "shape"),
    [
        ("text", (1, 4)),
        (np.ones((2, 3)), (3, 2)),
        (np.ones((2, 3)), (6,)),
        (np.array([[np.nan]]), (1, 1)),
        (np.array([[1e300]]), (1, 1)),
        ([1, 2], (1, 2)),
    ],
)
def test_numbers_of_another_shape_or_kind(value: Any, shape: tuple[int, ...]) -> None:
    with pytest.raises(InvalidModel, match="The weight"):
        numbers(value, "The weight", *shape)


# Files that ask for too much


HEADER = b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + b"\x00\x01IM"


def nested(depth: int) -> bytes:
    """A cell within a cell within a cell …, as one element."""
    number = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, 1, 1) + struct.pack("<II", 1, 0)
    number += struct.pack("<IId", 9, 8, 1.0)
    heads: list[bytes] = []
    size = 8 + len(number)
    for level in range(depth):
        name = struct.pack("<HH4s", 1, 1, b"x") if level == depth - 1 else struct.pack("<II", 1, 0)
        head = struct.pack("<IIII", 6, 8, 1, 0) + struct.pack("<IIii", 5, 8, 1, 1) + name
        size += len(head)
        heads.append(struct.pack("<II", 14, size) + head)
        size += 8
    return b"".join(reversed(heads)) + struct.pack("<II", 14, len(number)) + number


@pytest.mark.thorough
@pytest.mark.parametrize("compressed", [False, True])
def test_nesting_ends_in_an_error_not_in_the_process(tmp_path: Path, compressed: bool) -> None:
    element = nested(20_000)
    if compressed:
        packed = zlib.compress(element)
        element = struct.pack("<II", 15, len(packed)) + packed
    (tmp_path / "a.mat").write_bytes(HEADER + element)
    with pytest.raises(InvalidModel, match=r"a\.mat cannot be used"):
        read_mat(tmp_path / "a.mat")


def test_little_nesting_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.mat").write_bytes(HEADER + nested(3))
    ((((number,),),),) = (read_mat(tmp_path / "a.mat")["x"],)
    assert number.tolist() == [[1.0]]


@pytest.mark.thorough
def test_what_is_packed_small_takes_no_more_memory_than_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    savemat(tmp_path / "a.mat", {"zeros": np.zeros(40_000_000)}, do_compression=True)
    assert (tmp_path / "a.mat").stat().st_size < 500_000
    monkeypatch.setattr(isolation, "SPARE_MEMORY", 2**28)
    with pytest.raises(InvalidModel, match="too much memory"):
        read_mat(tmp_path / "a.mat")


@pytest.mark.parametrize(
    "content", [b"", b"MATLAB", HEADER[:-2] + b"MI", b"x" * 200, HEADER + b"\x0e\0\0\0\xff\xff\0\0"]
)
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(InvalidModel, match=r"a\.mat"):
        read_mat(tmp_path / "a.mat")
    with pytest.raises(InvalidModel, match=r"b\.mat cannot be read"):
        read_mat(tmp_path / "b.mat")
