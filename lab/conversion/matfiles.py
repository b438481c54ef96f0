"""MATLAB's ``.mat`` files of level 5, in which MatConvNet (Vedaldi and Lenc, 2015) keeps its networks.

``scipy.io.loadmat`` reads them, in a process of its own (``lab.conversion.isolation``), because it trusts what a file
says of itself and may end the process with a damaged one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file

from core.errors import InvalidModel
from lab.conversion.isolation import Contents, Tree, first_bytes, read_in_child, serve

Value = Any  # str, NDArray, list (a cell), dict (a structure), or Unreadable

_HDF5 = b"\x89HDF\r\n\x1a\n"

MAX_DEPTH = 32
"""Structures and cells within each other; networks have about four."""


@dataclass(frozen=True)
class Unreadable:
    """An object of a MATLAB class, a function, or numbers of a kind that no network has."""

    kind: str


def read_mat(path: Path) -> dict[str, Value]:
    """The variables of a file by name.

    A structure becomes a dict (several in an array a list), a cell a list in MATLAB's order, text a str, numbers an
    array of the sides that MATLAB sees, at least two.

    Raises:
        InvalidModel: it is of MATLAB's 7.3 format, no ``.mat`` file, or damaged.
    """
    header = first_bytes(path, 128)
    if header.startswith((b"MATLAB 7.3", _HDF5)):
        raise InvalidModel(f"{path.name} is of MATLAB's 7.3 format (HDF5); save it in MATLAB again, with '-v7'.")
    if header[126:] != b"IM":
        raise InvalidModel(f"{path.name} is not a MATLAB file of level 5 from a little-endian machine.")
    contents = read_in_child(__name__, path, framework="numpy")
    return {name: _value(described, contents) for name, described in contents.tree.items()}


def is_mat(path: Path) -> bool:
    """Whether a file begins as MATLAB's do, of level 5 or 7.3."""
    try:
        return first_bytes(path, 8).startswith((b"MATLAB", _HDF5))
    except InvalidModel:
        return False


def numbers(value: Value, what: str, *shape: int | None) -> NDArray[np.float32]:
    """Numbers as float32 of a shape; MATLAB drops sides of length 1 at the end, they are put back.

    Args:
        what: the name for the reader of an error.
        shape: sides; None for any.

    Raises:
        InvalidModel: it holds no numbers, of another shape, or some that are not finite.
    """
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise InvalidModel(f"{what} does not hold numbers.")
    found = value.shape + (1,) * (len(shape) - value.ndim)
    if len(found) != len(shape) or any(side not in (None, have) for side, have in zip(shape, found, strict=True)):
        wanted = " x ".join("any" if side is None else str(side) for side in shape)
        raise InvalidModel(f"{what} has the shape {value.shape}; {wanted} is needed.")
    with np.errstate(over="ignore"):  # a double too large for a float is found below
        numbers = np.array(value.reshape(found), np.float32, order="C")
    if not np.isfinite(numbers).all():
        raise InvalidModel(f"{what} holds values that are not finite.")
    return numbers


def _value(described: tuple[str, Any], arrays: Contents) -> Value:
    kind, content = described
    match kind:
        case "numbers":
            return arrays[content]
        case "cell":
            return [_value(item, arrays) for item in content]
        case "structure":
            return {name: _value(item, arrays) for name, item in content.items()}
        case "text":
            return content
        case _:
            return Unreadable(content)


# In the child process


def _read(path: Path) -> tuple[Tree, dict[str, NDArray[Any]]]:
    """Each variable as its kind and its content; numbers lie among the arrays."""
    from scipy.io import loadmat  # noqa: TID251 in the child process

    arrays: dict[str, NDArray[Any]] = {}
    found = loadmat(path, struct_as_record=False)
    tree = {name: _described(value, arrays) for name, value in found.items() if not name.startswith("__")}
    return tree, arrays


def _described(value: Any, arrays: dict[str, NDArray[Any]], depth: int = 0) -> tuple[str, Any]:
    if depth > MAX_DEPTH:
        raise InvalidModel("its structures are too deep.")
    from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque, mat_struct

    match value:
        case mat_struct():
            return "structure", {
                name: _described(getattr(value, name), arrays, depth + 1) for name in value._fieldnames
            }
        case MatlabObject():
            return "unreadable", value.classname
        case MatlabOpaque():
            return "unreadable", str(value[0]["s2"].tobytes().decode("latin-1"))
        case np.ndarray(dtype=np.dtype(kind="O")) if not isinstance(value, MatlabFunction):
            items = [_described(item, arrays, depth + 1) for item in value.ravel(order="F")]
            return items[0] if len(items) == 1 and isinstance(value.flat[0], mat_struct) else ("cell", items)
        case np.ndarray(dtype=np.dtype(kind="U")):
            return "text", "\n".join(value.ravel().tolist())
        case np.ndarray(dtype=np.dtype(kind="f" | "i" | "u")):
            name = str(len(arrays))
            arrays[name] = np.ascontiguousarray(value)  # safetensors takes the bytes as they lie
            return "numbers", name
        case _:
            return "unreadable", type(value).__name__


if __name__ == "__main__":
    serve(_read, save_file)
