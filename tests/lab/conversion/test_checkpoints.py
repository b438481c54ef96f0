"""Checkpoints that PyTorch itself wrote, and hostile ones that are put together byte by byte."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from core.errors import InvalidModel
from lab.conversion import isolation
from lab.conversion.checkpoints import read_checkpoint, under
from tests.lab.conversion import in_process

# Instructions of a pickle


def text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def whole(value: int) -> bytes:
    content = value.to_bytes(9, "little", signed=True)
    return b"\x8a" + bytes([len(content)]) + content


def row(*values: bytes) -> bytes:
    return b"(" + b"".join(values) + b"t"


def storage(key: str = "0", count: int = 4, kind: bytes = b"torch\nFloatStorage") -> bytes:
    return row(text("storage"), b"c" + kind + b"\n", text(key), text("cpu"), whole(count)) + b"Q"


def tensor(shape: list[int], strides: list[int], offset: int = 0, numbers: bytes = storage()) -> bytes:
    sides, steps = row(*map(whole, shape)), row(*map(whole, strides))
    return b"ctorch._utils\n_rebuild_tensor_v2\n" + row(numbers, whole(offset), sides, steps, b"\x89", b"N") + b"R"


def named(**values: bytes) -> bytes:
    return b"}(" + b"".join(text(key) + value for key, value in values.items()) + b"u"


def zipped(path: Path, described: bytes, numbers: bytes = np.arange(4, dtype="<f4").tobytes()) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("net/data.pkl", b"\x80\x02" + described + b".")
        archive.writestr("net/data/0", numbers)
        archive.writestr("net/version", "3\n")
    return path


# What PyTorch writes


@pytest.fixture(scope="module")
def state() -> dict[str, object]:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4))
    optimizer = torch.optim.SGD(network.parameters(), lr=0.1, momentum=0.9)
    network(torch.rand(1, 3, 5, 5)).sum().backward()
    optimizer.step()
    numbers = torch.arange(24.0).reshape(2, 3, 4)
    return {
        "epoch": 3,
        "best_score": np.float64(0.25),
        "recalls": {1: np.float64(0.5)},
        "state_dict": network.state_dict(),
        "optimizer": optimizer.state_dict(),
        "part": numbers[:, 1:, ::2],
        "same": numbers,
        "parameter": nn.Parameter(torch.ones(3)),
        "half": torch.ones(2).half(),
        "brain": torch.ones(2).bfloat16(),
        "flags": torch.tensor([True, False]),
        "none": torch.empty(0, 3),
        "one": torch.tensor(5),
        "shape": numbers.shape,
        "last": torch.rand(2, 3, 4, 4).to(memory_format=torch.channels_last),
    }


@pytest.mark.thorough
@pytest.mark.parametrize("zipped_layout", [True, False])
def test_what_pytorch_writes_is_read_to_the_bit(state: dict[str, object], tmp_path: Path, zipped_layout: bool) -> None:
    path = tmp_path / "model_best.pth.tar"
    torch.save(state, path, _use_new_zipfile_serialization=zipped_layout)
    found = read_checkpoint(path)
    wanted = {name: value for name, value in state.items() if isinstance(value, Tensor)}
    wanted |= {f"state_dict.{name}": value for name, value in state["state_dict"].items()}  # type: ignore[attr-defined]
    assert {name for name in found if not name.startswith("optimizer.")} == set(wanted)
    for name, value in wanted.items():
        assert found[name].dtype == value.dtype and torch.equal(found[name], value.detach())
    assert set(under(found, "state_dict.1.")) == {
        "weight",
        "bias",
        "running_mean",
        "running_var",
        "num_batches_tracked",
    }


@pytest.mark.thorough
def test_a_state_dict_alone_and_its_safetensors_sibling(tmp_path: Path) -> None:
    tensors = {"encoder.0.weight": torch.rand(2, 3), "pool.centroids": torch.rand(4)}
    torch.save(tensors, tmp_path / "plain.pth")
    save_file(tensors, tmp_path / "plain.safetensors", {"tree": "of another kind"})
    for name in ("plain.pth", "plain.safetensors"):
        found = read_checkpoint(tmp_path / name)
        assert sorted(found) == sorted(tensors) and len(found) == 2
        assert all(torch.equal(found[key], tensors[key]) for key in tensors)
        with pytest.raises(KeyError):
            found["pool"]


@pytest.mark.thorough
def test_a_whole_module_is_refused_with_what_to_do(tmp_path: Path) -> None:
    for zipped_layout in (True, False):
        torch.save(nn.Linear(2, 2), tmp_path / "whole.pth", _use_new_zipfile_serialization=zipped_layout)
        with pytest.raises(InvalidModel, match=r"whole\.pth cannot be used: .*Linear.*save the network's state_dict"):
            read_checkpoint(tmp_path / "whole.pth")


# What others may write


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    in_process.use(monkeypatch, "lab.conversion.checkpoints")


@pytest.mark.usefixtures("here")
def test_the_hand_made_file_is_sound(tmp_path: Path) -> None:
    found = read_checkpoint(zipped(tmp_path / "a.pth", named(w=tensor([2, 2], [1, 2]))))
    assert found["w"].tolist() == [[0, 2], [1, 3]]


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    "described",
    [
        b"cposix\nsystem\n(" + text("touch made") + b"tR",
        b"cbuiltins\neval\n(" + text("1") + b"tR",
        b"cbuiltins\ngetattr\n(ctorch\nload\n" + text("x") + b"tR",
        text("posix") + text("system") + b"\x93" + b"(" + text("x") + b"tR",
        b"(" + text("x") + b"iposix\nsystem\n",  # INST
        b"cposix\nsystem\n)\x81",  # NEWOBJ
        b"cposix\nsystem\n}b",  # BUILD
        b"\x82\x01",  # EXT1
    ],
)
def test_nothing_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, described: bytes) -> None:
    monkeypatch.chdir(tmp_path)
    path = zipped(tmp_path / "a.pth", named(w=described))
    with pytest.raises(InvalidModel, match=r"a\.pth"):
        read_checkpoint(path)
    legacy = tmp_path / "b.pth"
    legacy.write_bytes(b"\x80\x02" + described + b".")
    with pytest.raises(InvalidModel, match=r"b\.pth"):
        read_checkpoint(legacy)
    assert not (tmp_path / "made").exists()


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    "described",
    [
        tensor([5], [1]),
        tensor([2], [1], offset=3),
        tensor([2, 2], [1, 3]),
        tensor([-1], [1]),
        tensor([2], [-1]),
        tensor([2**62, 2**62], [1, 1]),
        tensor([2, 2], [1]),
        tensor([2], [1], numbers=storage(count=-4)),
        tensor([2], [1], numbers=storage(kind=b"numpy\nFloatStorage")),
        tensor([2], [1], numbers=storage()).replace(b"storage", b"modules", 1),
        tensor([2], [1], numbers=storage("1")),
        tensor([2], [1], numbers=storage("../0")),
        tensor([2], [1], numbers=storage(count=5)),
        b"ctorch._utils\n_rebuild_tensor_v2\n)R",
        named() + b"q\x00" + text("again") + b"h\x00s",  # a dictionary within itself
        b"(((((",
        b"h\x07",
    ],
)
def test_descriptions_that_cannot_be(tmp_path: Path, described: bytes) -> None:
    with pytest.raises(InvalidModel, match=r"a\.pth cannot be used"):
        read_checkpoint(zipped(tmp_path / "a.pth", named(w=described)))


@pytest.mark.usefixtures("here")
def test_what_is_small_in_the_file_cannot_be_endless(tmp_path: Path) -> None:
    folders = {"a": named(w=tensor([1], [1])) + b"q\x00"}
    for depth in range(1, 15):  # each has the one before it eleven times
        inner = b"}(" + b"".join(text(str(i)) + b"h" + bytes([depth - 1]) for i in range(11)) + b"u"
        folders["a" * (depth + 1)] = inner + b"q" + bytes([depth])
    with pytest.raises(InvalidModel, match="too deep or too many"):
        read_checkpoint(zipped(tmp_path / "a.pth", named(**folders)))


@pytest.mark.thorough
@pytest.mark.parametrize("described", [tensor([1_000_000_000], [0]), tensor([2], [1], numbers=storage(count=2**40))])
def test_one_number_repeated_or_a_huge_announcement_takes_no_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, described: bytes
) -> None:
    monkeypatch.setattr(isolation, "SPARE_MEMORY", 2**29)
    with pytest.raises(InvalidModel, match=r"a\.pth cannot be used"):
        read_checkpoint(zipped(tmp_path / "a.pth", named(w=described)))


@pytest.mark.thorough
def test_what_is_packed_small_takes_no_more_memory_than_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with zipfile.ZipFile(tmp_path / "a.pth", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        described = named(w=tensor([2**27], [1], numbers=storage(count=2**27)))
        archive.writestr("net/data.pkl", b"\x80\x02" + described + b".")
        archive.writestr("net/data/0", bytes(2**29))
        archive.writestr("net/version", "3\n")
    assert (tmp_path / "a.pth").stat().st_size < 10_000_000
    monkeypatch.setattr(isolation, "SPARE_MEMORY", 2**28)
    with pytest.raises(InvalidModel, match=r"a\.pth cannot be used"):
        read_checkpoint(tmp_path / "a.pth")


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04", b"\x80\x02K\x01.", b"\x00" * 8 + b"{", b"\x80\x02"])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.pth").write_bytes(content)
    with pytest.raises(InvalidModel, match=r"a\.pth"):
        read_checkpoint(tmp_path / "a.pth")
    with pytest.raises(InvalidModel, match=r"b\.pth"):
        read_checkpoint(tmp_path / "b.pth")
