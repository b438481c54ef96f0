"""What a checkpoint's pickle describes, read without running it.

A pickle is a program for a stack machine; ``pickletools.genops`` lists its instructions and runs none.  Of
these the few that write dicts, lists, tuples, numbers, strings and tensors are interpreted here; whatever
else a file asks for is refused, so no name that it contains is ever looked up, let alone called.
"""

from __future__ import annotations

import math
import pickletools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, BinaryIO

import torch

from core.errors import InvalidModel

Value = Any  # None, bool, int, float, str, bytes, list, dict, tuple, or one of the classes below

MAX_INSTRUCTIONS = 2_000_000
"""Of one pickle; a checkpoint of a thousand tensors with its optimizer's has some fifty thousand."""

MAX_DIMENSIONS = 8
MAX_LENGTH = 2**48
"""Of a side, a stride or a name that is a number: what is longer cannot be meant, and is slow to count with."""


@dataclass(frozen=True)
class Storage:
    """A run of ``count`` numbers of one kind that lies elsewhere in the file under ``key``."""

    key: str
    dtype: torch.dtype
    count: int


@dataclass(frozen=True)
class TensorView:
    """How a tensor lies in its storage, in elements; everything it sees is within the storage."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    @property
    def count(self) -> int:
        """Elements of the tensor."""
        return math.prod(self.shape)

    @property
    def span(self) -> int:
        """Elements of the storage from its first to its last element."""
        return 1 + sum((side - 1) * stride for side, stride in zip(self.shape, self.strides, strict=True))


@dataclass(frozen=True)
class _Name:
    """What a pickle would import: a word here."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"[:100]


class _Unread:
    """Stands for a NumPy number beside the weights, such as the score of an epoch: nothing here needs it."""


_REMEDY = "save the network's state_dict and give that file."
_MARK = object()

_DTYPES = {
    "DoubleStorage": torch.float64, "FloatStorage": torch.float32, "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16, "LongStorage": torch.int64, "IntStorage": torch.int32,
    "ShortStorage": torch.int16, "CharStorage": torch.int8, "ByteStorage": torch.uint8, "BoolStorage": torch.bool,
}  # fmt: skip
_TENSORS = {("torch._utils", "_rebuild_tensor"), ("torch._utils", "_rebuild_tensor_v2")}
_NUMPY = {
    ("numpy", "dtype"), ("numpy.core.multiarray", "scalar"), ("numpy._core.multiarray", "scalar"),
    ("_codecs", "encode"),
}  # fmt: skip
_CONSTANTS = {
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT",
    "STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8",
    "BINBYTES", "SHORT_BINBYTES", "BINBYTES8",
}  # fmt: skip
_MADE: dict[str, Callable[[], Value]] = {
    "NONE": lambda: None, "NEWTRUE": lambda: True, "NEWFALSE": lambda: False,
    "EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple, "MARK": lambda: _MARK,
}  # fmt: skip
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


@dataclass(frozen=True)
class Description:
    """The value that a pickle describes, and all storages that it speaks of, by key."""

    value: Value
    storages: dict[str, Storage]


def read_pickle(file: BinaryIO) -> Description:
    """What a pickle describes; the file is left behind its last instruction.

    Args:
        file: bytes that are bounded already: an instruction may read all of them at once.

    Raises:
        InvalidModel: it is damaged, or asks for more than plain containers, numbers, strings and tensors.
    """
    machine = _Machine()
    try:
        for count, (instruction, argument, _) in enumerate(pickletools.genops(file)):
            if count >= MAX_INSTRUCTIONS:
                raise InvalidModel(f"The checkpoint's description has more than {MAX_INSTRUCTIONS} instructions.")
            if instruction.name == "STOP":
                return Description(machine.pop(), machine.storages)
            machine.step(instruction.name, argument)
    except InvalidModel:
        raise
    except Exception as error:  # of damaged bytes, pickletools raises whatever its parsers raise
        raise InvalidModel(f"The checkpoint's description is damaged: {error}.") from error
    raise InvalidModel("The checkpoint's description does not end.")


class _Machine:
    """The stack and the memory of values to be used again."""

    def __init__(self) -> None:
        self.stack: list[Value] = []
        self.memory: dict[int, Value] = {}
        self.storages: dict[str, Storage] = {}

    def pop(self, kind: type | tuple[type, ...] = object) -> Value:
        """Take the top value, which must be of a kind and no mark."""
        if not self.stack or self.stack[-1] is _MARK or not isinstance(self.stack[-1], kind):
            raise InvalidModel("The checkpoint's description is damaged: a value is missing.")
        return self.stack.pop()

    def pop_to_mark(self) -> list[Value]:
        """Take the values above the last mark, and the mark."""
        above: list[Value] = []
        while self.stack and self.stack[-1] is not _MARK:
            above.append(self.stack.pop())
        if not self.stack:
            raise InvalidModel("The checkpoint's description is damaged: a mark is missing.")
        self.stack.pop()
        return above[::-1]

    def step(self, name: str, argument: Any) -> None:
        """Interpret one instruction."""
        if name in _CONSTANTS:
            self.stack.append(argument)
        elif name in _MADE:
            self.stack.append(_MADE[name]())
        elif name in _TUPLES:
            values = [self.pop() for _ in range(_TUPLES[name])]
            self.stack.append(tuple(values[::-1]))
        else:
            self._step_on(name, argument)

    def _step_on(self, name: str, argument: Any) -> None:
        match name:
            case "PROTO" | "FRAME":
                pass
            case "TUPLE":
                self.stack.append(tuple(self.pop_to_mark()))
            case "LIST":
                self.stack.append(self.pop_to_mark())
            case "DICT":
                self.stack.append({})
                self._set_items(self._below_mark())
            case "APPEND":
                value = self.pop()
                self._top(list).append(value)
            case "APPENDS":
                values = self.pop_to_mark()
                self._top(list).extend(values)
            case "SETITEM":
                value, key = self.pop(), self.pop()
                self._set_items([key, value])
            case "SETITEMS":
                self._set_items(self.pop_to_mark())
            case "POP":
                self.pop()
            case "POP_MARK":
                self.pop_to_mark()
            case "PUT" | "BINPUT" | "LONG_BINPUT":
                self.memory[argument] = self._top(object)
            case "MEMOIZE":
                self.memory[len(self.memory)] = self._top(object)
            case "GET" | "BINGET" | "LONG_BINGET":
                self.stack.append(self.memory[argument])
            case "GLOBAL":
                module, _, word = argument.partition(" ")
                self.stack.append(_Name(module, word))
            case "STACK_GLOBAL":
                word, module = self.pop(str), self.pop(str)
                self.stack.append(_Name(module, word))
            case "BINPERSID":
                self.stack.append(self._storage(self.pop(tuple)))
            case "REDUCE":
                arguments, function = self.pop(tuple), self.pop(_Name)
                self.stack.append(_call(function, arguments))
            case "BUILD":
                # Attributes of an ordered dict (versions of a network's parts), or of a NumPy type.
                self.pop()
                self._top((dict, _Unread))
            case _:
                raise InvalidModel(f"The checkpoint holds an object (instruction {name}), not only tensors; {_REMEDY}")

    def _top(self, kind: type | tuple[type, ...]) -> Any:
        value = self.pop(kind)
        self.stack.append(value)
        return value

    def _below_mark(self) -> list[Value]:
        """The values above the last mark of a stack on whose top a new value lies, which stays."""
        new = self.stack.pop()
        values = self.pop_to_mark()
        self.stack.append(new)
        return values

    def _set_items(self, values: list[Value]) -> None:
        target: dict[Value, Value] = self._top(dict)
        keys = values[::2]
        if len(values) % 2 or not all(type(key) is str or _is_length(key) for key in keys):
            raise InvalidModel("The checkpoint has a dictionary whose keys are neither names nor whole numbers.")
        target.update(zip(keys, values[1::2], strict=True))

    def _storage(self, described: tuple[Value, ...]) -> Storage:
        """A storage by its persistent id: ``("storage", type, key, device, count[, view])``."""
        match described:
            case ("storage", _Name(module="torch", name=kind), str() as key, _, count, *view) if (
                kind in _DTYPES and _is_length(count) and view in ([], [None])
            ):
                storage = Storage(key, _DTYPES[kind], count)
            case ("storage", _Name() as kind, *_):
                raise InvalidModel(f"The checkpoint holds numbers of the kind {kind}, which cannot be read.")
            case _:
                raise InvalidModel(f"The checkpoint holds a whole module, not its tensors; {_REMEDY}")
        if self.storages.setdefault(key, storage) != storage:
            raise InvalidModel(f"The checkpoint describes the numbers {key[:40]!r} in two ways.")
        return storage


def _is_length(value: Value) -> bool:
    return type(value) is int and 0 <= value <= MAX_LENGTH


def _call(function: _Name, arguments: tuple[Value, ...]) -> Value:
    """What calling ``function`` would give, for the few that make plain values."""
    name = (function.module, function.name)
    if name in _TENSORS:
        return _tensor(arguments)
    match name, arguments:
        case ("torch._utils", "_rebuild_parameter"), (TensorView() as view, *_):
            return view
        case ("collections", "OrderedDict"), ():
            return {}
        case ("torch", "Size"), (tuple() as sides,):
            return sides
    if name in _NUMPY:
        return _Unread()
    raise InvalidModel(f"The checkpoint holds {function}, not only tensors; {_REMEDY}")


def _tensor(arguments: tuple[Value, ...]) -> TensorView:
    match arguments:
        case (Storage() as storage, int() as offset, tuple() as shape, tuple() as strides, *_):
            view = TensorView(storage, offset, shape, strides)
        case _:
            raise InvalidModel("The checkpoint describes a tensor in a way that cannot be read.")
    if len(shape) > MAX_DIMENSIONS or not all(_is_length(length) for length in (offset, *shape, *strides)):
        raise InvalidModel("The checkpoint has a tensor whose shape cannot be.")
    # The count bounds the memory that a tensor takes: a stride of zero could repeat one number for ever.
    fits = len(shape) == len(strides) and view.count <= storage.count
    if not fits or (view.count and offset + view.span > storage.count):
        raise InvalidModel(f"The checkpoint has a tensor of the shape {shape} that is larger than its numbers.")
    return view
