"""PyTorch checkpoints and safetensors files as plain tensors by name.

Three layouts are read: safetensors; the zip file of PyTorch since 1.6 (``data.pkl`` and one entry for each storage);
and the older one (pickles, then the storages one after another), which many published networks still have.
``core.networks.pickles`` reads the descriptions of tensors without executing them.
"""

from __future__ import annotations

import io
import mmap
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from core.errors import InvalidModel
from core.networks.pickles import Description, Storage, TensorView, Value, read_pickle

MAX_DESCRIPTION = 16 * 2**20
"""Largest pickle that describes tensors, in bytes; that of a network with a thousand tensors has 200 kB."""

MAX_TENSORS = 100_000

MAX_DEPTH = 16
"""Deepest nesting of dictionaries."""

MAX_NAME = 500
"""Longest joined name, in characters."""

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_VERSION = 1001

Bytes = Callable[[Storage], memoryview]


class Checkpoint(Mapping[str, Tensor]):
    """Tensors by name, each read when it is looked up.

    The keys of nested dictionaries are joined by dots: ``state_dict.encoder.0.weight``.
    """

    def __init__(self, views: Mapping[str, TensorView], numbers: Bytes) -> None:
        self._views, self._numbers = views, numbers

    def __iter__(self) -> Iterator[str]:
        return iter(self._views)

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, name: str) -> Tensor:
        view = self._views[name]
        dtype = view.storage.dtype
        if not view.count:
            return torch.empty(view.shape, dtype=dtype)
        start = view.offset * dtype.itemsize
        piece = self._numbers(view.storage)[start : start + view.span * dtype.itemsize]
        numbers = torch.from_numpy(np.frombuffer(piece, np.uint8).copy()).view(dtype)
        return numbers.as_strided(view.shape, view.strides).contiguous()


class _Safetensors(Mapping[str, Tensor]):
    """The same for a safetensors file."""

    def __init__(self, path: Path) -> None:
        self._file = cast(Any, safe_open(path, "pt"))
        self._names = tuple(self._file.keys())

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._names:
            raise KeyError(name)
        tensor: Tensor = self._file.get_tensor(name)
        return tensor


def read_checkpoint(path: Path) -> Mapping[str, Tensor]:
    """Open a file of one of the three layouts, which differ in their first bytes.

    Raises:
        InvalidModel: the file cannot be read, has another layout, is damaged, or holds more than plain tensors.
    """
    try:
        with path.open("rb") as file:
            content = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except (OSError, ValueError) as error:
        raise InvalidModel(f"{path.name} cannot be read: {error}") from error
    try:
        if bytes(content[:4]) == b"PK\x03\x04":
            return _read_zip(path, content)
        if bytes(content[8:9]) == b"{":
            return _Safetensors(path)
        if bytes(content[:1]) == b"\x80":
            return _read_legacy(content)
    except InvalidModel as error:
        raise InvalidModel(f"{path.name} cannot be used. {error}") from error
    except SafetensorError as error:
        raise InvalidModel(f"{path.name} is not a readable safetensors file: {error}") from error
    raise InvalidModel(f"{path.name} is neither a PyTorch checkpoint nor a safetensors file.")


def under(checkpoint: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Read the tensors whose name starts with ``prefix``, by the rest of their name."""
    return {name.removeprefix(prefix): checkpoint[name] for name in checkpoint if name.startswith(prefix)}


def as_float(tensor: Tensor, what: str, *shape: int | None) -> Tensor:
    """Convert a tensor to float32 and check its shape; None stands for a side of any length.

    Raises:
        InvalidModel: the tensor has another shape, or values that are not finite.
    """
    if tensor.ndim != len(shape) or any(s not in (None, have) for s, have in zip(shape, tensor.shape, strict=True)):
        wanted = " x ".join("any" if side is None else str(side) for side in shape)
        raise InvalidModel(f"{what} has the shape {tuple(tensor.shape)}; {wanted} is needed.")
    found = tensor.to(torch.float32)
    if not torch.isfinite(found).all():
        raise InvalidModel(f"{what} holds values that are not finite.")
    return found


# The zip


def _read_zip(path: Path, content: memoryview) -> Checkpoint:
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {entry.filename: entry for entry in archive.infolist()}
    except Exception as error:  # of a damaged directory, zipfile raises whatever its parsers raise
        raise InvalidModel(f"It is a damaged zip: {error}.") from error
    described = [name for name in entries if name.endswith("/data.pkl") and name.count("/") == 1]
    if len(described) != 1:
        raise InvalidModel("It is a zip, but not a PyTorch checkpoint: it has no data.pkl.")
    folder = described[0].removesuffix("data.pkl")
    order = entries.get(f"{folder}byteorder")
    if order is not None and bytes(_entry(content, order)) != b"little":
        raise InvalidModel("Its numbers are not little-endian.")

    def numbers(storage: Storage) -> memoryview:
        entry = entries.get(f"{folder}data/{storage.key}")
        if entry is None or entry.file_size != storage.count * storage.dtype.itemsize:
            raise InvalidModel(f"The checkpoint lacks the numbers {storage.key[:40]!r}, or has too few.")
        return _entry(content, entry)

    pickled = _entry(content, entries[described[0]])
    if len(pickled) > MAX_DESCRIPTION:
        raise InvalidModel(f"Its description has more than {MAX_DESCRIPTION} bytes.")
    return Checkpoint(_flatten(read_pickle(io.BytesIO(pickled)).value), numbers)


def _entry(content: memoryview, entry: zipfile.ZipInfo) -> memoryview:
    """The bytes of an entry where they lie: PyTorch compresses none, so nothing can grow on reading."""
    start = entry.header_offset
    header = content[start : start + 30]
    if entry.compress_type != zipfile.ZIP_STORED or len(header) < 30 or bytes(header[:4]) != b"PK\x03\x04":
        raise InvalidModel(f"The entry {entry.filename[:60]!r} is compressed or damaged.")
    start += 30 + int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:30], "little")
    piece = content[start : start + entry.file_size]
    if len(piece) != entry.file_size:
        raise InvalidModel(f"The entry {entry.filename[:60]!r} ends after the file.")
    return piece


# The older layout


def _read_legacy(content: memoryview) -> Checkpoint:
    """Five pickles (a magic number, a version, the machine, the value, the keys), then the numbers of each key."""
    position = 0

    def pickle() -> Description:
        nonlocal position
        file = io.BytesIO(content[position : position + MAX_DESCRIPTION])
        described = read_pickle(file)
        position += file.tell()
        return described

    if pickle().value != _LEGACY_MAGIC or pickle().value != _LEGACY_VERSION:
        raise InvalidModel("It is a pickle, but not a PyTorch checkpoint.")
    system = pickle().value
    if not isinstance(system, dict) or system.get("little_endian") is not True:
        raise InvalidModel("Its numbers are not little-endian.")
    described, keys = pickle(), pickle().value
    runs = _runs(content, position, keys, described.storages)
    return Checkpoint(_flatten(described.value), lambda storage: runs[storage.key])


def _runs(content: memoryview, start: int, keys: Value, storages: Mapping[str, Storage]) -> dict[str, memoryview]:
    """The numbers of each storage: in the order of ``keys``, their count (int64) before each."""
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys) or set(keys) != set(storages):
        raise InvalidModel("Its list of numbers is not that of its tensors.")
    runs: dict[str, memoryview] = {}
    for key in keys:
        storage = storages[key]
        end = start + 8 + storage.count * storage.dtype.itemsize
        if end > len(content) or int.from_bytes(content[start : start + 8], "little") != storage.count:
            raise InvalidModel(f"The checkpoint is cut or damaged at the numbers {key[:40]!r}.")
        runs[key] = content[start + 8 : end]
        start = end
    return runs


# What it describes


def _flatten(root: Value) -> dict[str, TensorView]:
    """The tensors of dictionaries within dictionaries by their joined names; lists hold none that has a name."""
    if not isinstance(root, dict):
        raise InvalidModel("It holds no tensors by name; save the network's state_dict.")
    found: dict[str, TensorView] = {}
    waiting: list[tuple[str, Value, int]] = [("", root, 0)]
    seen = 0
    while waiting:
        prefix, folder, depth = waiting.pop()
        seen += len(folder)
        # A dictionary may hold another one twice, so what is small in the file can be endless when unfolded.
        if depth > MAX_DEPTH or seen > MAX_TENSORS:
            raise InvalidModel("Its dictionaries are too deep or too many.")
        for key, value in folder.items():
            name = f"{prefix}{key}"
            if len(name) > MAX_NAME or name in found:
                raise InvalidModel(f"It has a name twice, or one that is too long: {name[:60]!r}.")
            if isinstance(value, TensorView):
                found[name] = value
            elif isinstance(value, dict):
                waiting.append((f"{name}.", value, depth + 1))
    return found
