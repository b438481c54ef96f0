"""PyTorch checkpoints and safetensors files as plain tensors by name.

``torch.load(weights_only=True)`` reads the checkpoints, in a process of its own (``lab.conversion.isolation``).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from core.errors import InvalidModel
from lab.conversion.isolation import Contents, first_bytes, read_in_child, serve

MAX_TENSORS = 100_000

MAX_DEPTH = 16
"""Deepest nesting of dictionaries."""

_STARTS = (b"PK\x03\x04", b"\x80")
"""Of a checkpoint since PyTorch 1.6, a zip; and of an older one, pickles."""


def read_checkpoint(path: Path) -> Mapping[str, Tensor]:
    """Open a checkpoint or a safetensors file; each tensor is read when it is looked up.

    The keys of nested dictionaries are joined by dots: ``state_dict.encoder.0.weight``.

    Raises:
        InvalidModel: the file cannot be read, has another layout, is damaged, or holds more than plain tensors.
    """
    start = first_bytes(path, 9)
    if start[8:] == b"{":
        try:
            return Contents(path, "pt")
        except (OSError, SafetensorError) as error:
            raise InvalidModel(f"{path.name} is not a readable safetensors file: {error}") from error
    if not start.startswith(_STARTS):
        raise InvalidModel(f"{path.name} is neither a PyTorch checkpoint nor a safetensors file.")
    return read_in_child(__name__, path, framework="pt")


def is_checkpoint(path: Path) -> bool:
    """Whether a file begins as a checkpoint or a safetensors file does.

    Raises:
        InvalidModel: there is no such file, or it cannot be read.
    """
    start = first_bytes(path, 9)
    return start.startswith(_STARTS) or start[8:] == b"{"


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


# In the child process


class _Unread:
    """Stands for a NumPy number beside the weights, such as the score of an epoch: nothing here needs it."""

    def __init__(self, *_: object) -> None: ...

    def __setstate__(self, _: object) -> None: ...


_NUMPY: list[Callable[..., Any] | tuple[Callable[..., Any], str]] = [
    (_Unread, name)
    for name in ("numpy.dtype", "numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar", "_codecs.encode")
]


def _read(path: Path) -> tuple[None, dict[str, Tensor]]:
    """The tensors of a checkpoint by their joined names."""
    try:
        with torch.serialization.safe_globals(_NUMPY):
            tensors = _flatten(torch.load(path, map_location="cpu", weights_only=True))  # noqa: TID251 runs no code
        plain = torch.contiguous_format
        return None, {name: tensor.detach().clone(memory_format=plain) for name, tensor in tensors.items()}
    except (MemoryError, InvalidModel):
        raise
    except Exception as error:  # of damaged files, torch raises whatever its parsers do
        if "allocate" in str(error):
            raise MemoryError from error
        said = str(error)
        other = re.search(r"GLOBAL ([\w.]+)", said) or re.search(r"WeightsUnpickler error:\s*(.{1,200})", said)
        holds = f"more than tensors ({other[1]})" if other else f"what cannot be read ({said.splitlines()[0][:200]})"
        raise InvalidModel(
            f"The checkpoint holds {holds}; save the network's state_dict by torch.save and give that file."
        ) from error


def _flatten(root: Any) -> dict[str, Tensor]:
    """The tensors of dictionaries within dictionaries by their joined names; lists hold none that has a name."""
    if not isinstance(root, dict):
        raise InvalidModel("It holds no tensors by name; save the network's state_dict.")
    found: dict[str, Tensor] = {}
    waiting: list[tuple[str, dict[Any, Any], int]] = [("", root, 0)]
    seen = 0
    while waiting:
        prefix, folder, depth = waiting.pop()
        seen += len(folder)
        # A dictionary may hold another one twice, so what is small in the file can be endless when unfolded.
        if depth > MAX_DEPTH or seen > MAX_TENSORS:
            raise InvalidModel("Its dictionaries are too deep or too many.")
        for key, value in folder.items():
            name = f"{prefix}{key}"
            if name in found:
                raise InvalidModel(f"It has the name {name[:60]!r} twice.")
            if isinstance(value, Tensor):
                found[name] = value
            elif isinstance(value, dict):
                waiting.append((f"{name}.", value, depth + 1))
    return found


if __name__ == "__main__":
    serve(_read, save_file)
