"""Caffe's files (Jia et al., 2014): the description and the weights of layers, and mean images.

A ``.caffemodel`` is a protobuf message with a description of each layer and its weights.  Two generations are read:
``layer`` (since 2014, types by name) and ``layers`` (before, types by number).  The protobuf package reads them, in a
process of its own (``lab.conversion.isolation``), by a description of the few fields that are needed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file

from core.errors import InvalidModel
from lab.conversion.isolation import Contents, Tree, read_in_child, serve

Part = dict[str, Any]
"""The fields of a group of parameters that the file sets, by name; lists where a field may repeat."""

_CONVOLUTION = {
    "channels": (1, "uint32"), "bias": (2, "bool"), "pad": (3, "uint32*"), "kernel": (4, "uint32*"),
    "groups": (5, "uint32"), "stride": (6, "uint32*"), "pad_h": (9, "uint32"), "pad_w": (10, "uint32"),
    "kernel_h": (11, "uint32"), "kernel_w": (12, "uint32"), "stride_h": (13, "uint32"), "stride_w": (14, "uint32"),
    "axis": (16, "int32"), "dilation": (18, "uint32*"),
}  # fmt: skip
_POOLING = {
    "method": (1, "int32"), "kernel": (2, "uint32"), "stride": (3, "uint32"), "pad": (4, "uint32"),
    "kernel_h": (5, "uint32"), "kernel_w": (6, "uint32"), "stride_h": (7, "uint32"), "stride_w": (8, "uint32"),
    "pad_h": (9, "uint32"), "pad_w": (10, "uint32"), "global": (12, "bool"), "rounding": (13, "int32"),
}  # fmt: skip
_MESSAGES: dict[str, dict[str, tuple[int, str]]] = {
    "Shape": {"dim": (1, "int64*")},
    "Blob": {
        "num": (1, "int32"), "channels": (2, "int32"), "height": (3, "int32"), "width": (4, "int32"),
        "floats": (5, "float*"), "shape": (7, "Shape"), "doubles": (8, "double*"),
    },
    "Convolution": _CONVOLUTION,
    "Pooling": _POOLING,
    "Normalization": {
        "size": (1, "uint32"), "alpha": (2, "float"), "beta": (3, "float"), "within": (4, "int32"), "k": (5, "float"),
    },
    "Relu": {"negative_slope": (1, "float")},
    "Transform": {"scale": (1, "float"), "crop": (3, "uint32"), "mean": (5, "float*")},
    "Data": {"scale": (2, "float"), "crop": (5, "uint32")},
    "Input": {"shape": (1, "Shape*")},
    "Layer": {
        "name": (1, "string"), "type": (2, "string"), "bottom": (3, "string*"), "top": (4, "string*"),
        "blobs": (7, "Blob*"), "transform": (100, "Transform"), "convolution": (106, "Convolution"),
        "data": (107, "Data"), "image_data": (115, "Data"), "normalization": (118, "Normalization"),
        "pooling": (121, "Pooling"), "relu": (123, "Relu"), "input": (143, "Input"),
    },
    "OldLayer": {
        "oldest": (1, "bytes"), "bottom": (2, "string*"), "top": (3, "string*"), "name": (4, "string"),
        "type": (5, "int32"), "blobs": (6, "Blob*"), "convolution": (10, "Convolution"), "data": (11, "Data"),
        "image_data": (15, "Data"), "normalization": (18, "Normalization"), "pooling": (19, "Pooling"),
        "relu": (30, "Relu"), "transform": (36, "Transform"),
    },
    "Net": {
        "old_layers": (2, "OldLayer*"), "input": (3, "string*"), "input_dim": (4, "int32*"),
        "input_shape": (8, "Shape*"), "layers": (100, "Layer*"),
    },
}  # fmt: skip
"""Caffe's messages as far as they are read: number and type of each field, ``*`` if it may repeat."""

_OLD_TYPES = {
    1: "Accuracy", 3: "Concat", 4: "Convolution", 5: "Data", 6: "Dropout", 7: "EuclideanLoss", 8: "Flatten",
    9: "HDF5Data", 10: "HDF5Output", 12: "ImageData", 13: "InfogainLoss", 14: "InnerProduct", 15: "LRN",
    16: "MultinomialLogisticLoss", 17: "Pooling", 18: "ReLU", 19: "Sigmoid", 20: "Softmax", 21: "SoftmaxWithLoss",
    22: "Split", 23: "TanH", 24: "WindowData", 25: "Eltwise", 26: "Power", 27: "SigmoidCrossEntropyLoss",
    28: "HingeLoss", 29: "MemoryData", 30: "ArgMax", 31: "Threshold", 32: "DummyData", 33: "Slice", 34: "MVN",
    35: "AbsVal", 36: "Silence", 37: "ContrastiveLoss", 38: "Exp", 39: "Deconvolution",
}  # fmt: skip


@dataclass(frozen=True)
class CaffeLayer:
    """A layer of either generation, as the file describes it.

    ``type`` is the type's name in the newer generation.  ``bottoms`` and ``tops`` are the blobs that the layer reads
    and writes.  ``parts`` has its groups of parameters, such as ``convolution``, by name.
    """

    name: str
    type: str
    bottoms: tuple[str, ...]
    tops: tuple[str, ...]
    parts: Mapping[str, Part]
    blobs: tuple[Part, ...]
    contents: Contents

    def part(self, key: str) -> Part:
        """One of its groups of parameters; empty if it has none."""
        return self.parts.get(key, {})

    def arrays(self) -> list[NDArray[np.float32]]:
        """Its weights, which are read only now.

        Raises:
            InvalidModel: the number of values does not fit the shape, or some are not finite.
        """
        return [_array(self.contents, blob, f"Array {place} of {self}") for place, blob in enumerate(self.blobs)]

    def __str__(self) -> str:
        return f"layer {self.name!r} ({self.type})"


@dataclass(frozen=True)
class CaffeNetwork:
    """The contents of a ``.caffemodel``: its layers in order, and its input if that is described outside of them."""

    input: str | None
    input_shape: tuple[int, ...]
    layers: tuple[CaffeLayer, ...]


def read_caffemodel(path: Path) -> CaffeNetwork:
    """Read the description of a network; its weights are read when they are needed.

    Raises:
        InvalidModel: the file cannot be read or is damaged.
    """
    contents = read_in_child(__name__, path, "network", framework="numpy")
    net: Part = contents.tree
    shapes = [shape.get("dim", []) for shape in net.get("input_shape", [])]
    return CaffeNetwork(
        input=next(iter(net.get("input", [])), None),
        input_shape=tuple(shapes[0] if shapes else net.get("input_dim", [])[:4]),
        layers=tuple(_layer(layer, contents) for layer in net["layers"]),
    )


def _layer(layer: Part, contents: Contents) -> CaffeLayer:
    code = layer.get("type", "")
    return CaffeLayer(
        name=layer.get("name", ""),
        type=code if isinstance(code, str) else _OLD_TYPES.get(code, f"number {code}"),
        bottoms=tuple(layer.get("bottom", [])),
        tops=tuple(layer.get("top", [])),
        parts={key: part for key, part in layer.items() if isinstance(part, dict)},
        blobs=tuple(layer["blobs"]),
        contents=contents,
    )


def _array(contents: Contents, blob: Part, title: str) -> NDArray[np.float32]:
    """The numbers of a BlobProto in its shape."""
    numbers: NDArray[np.float32] = contents[blob["array"]]
    shape = tuple(blob["shape"])
    if len(shape) > 8 or math.prod(shape) != len(numbers) or min(shape, default=0) < 0:
        raise InvalidModel(f"{title} has {len(numbers)} numbers, its shape is {shape[:8]}.")
    if not np.isfinite(numbers).all():
        raise InvalidModel(f"{title} holds values that are not finite.")
    return numbers.reshape(shape)


def read_mean(path: Path) -> tuple[float, float, float]:
    """The mean of each channel of a mean file, in the file's order (Caffe's is BGR), 0–255 units.

    Args:
        path: ``.npy`` with 3 or 3 x H x W numbers (or 1 x 3 x H x W); anything else is read as ``.binaryproto``.

    Raises:
        InvalidModel: it is neither, or not of three channels.
    """
    image: NDArray[Any]
    if path.suffix.lower() == ".npy":
        try:
            # Mapped, so that a header that announces more than the file holds allocates nothing.
            image = np.lib.format.open_memmap(path, mode="r")
        except Exception as error:  # of a damaged header NumPy raises whatever its parser raised
            raise InvalidModel(f"{path.name} is not a readable mean file: {error}") from error
        if image.dtype.kind not in "fiu":
            raise InvalidModel(f"{path.name} does not hold numbers.")
    else:
        contents = read_in_child(__name__, path, "mean", framework="numpy")
        image = _array(contents, contents.tree, path.name)
    if image.ndim == 4 and len(image) == 1:
        image = image[0]
    if image.ndim not in (1, 3) or len(image) != 3 or not image.size:
        raise InvalidModel(f"{path.name} has the shape {image.shape}; a mean is of 3 or 3 x height x width numbers.")
    with np.errstate(all="ignore"):
        blue, green, red = image.reshape(3, -1).mean(axis=1, dtype=np.float64).tolist()
    if not np.isfinite([blue, green, red]).all():
        raise InvalidModel(f"{path.name} holds values that are not finite.")
    return blue, green, red


# In the child process


def _read(path: Path, kind: str) -> tuple[Tree, dict[str, NDArray[Any]]]:
    """The description of a network or of a mean image, without its numbers, which lie among the arrays."""
    arrays: dict[str, NDArray[Any]] = {}
    if kind == "mean":
        return _stored(_parsed("Blob", path.read_bytes()), arrays), arrays
    net = _parsed("Net", path.read_bytes())
    layers = []
    for layer in net.layers or net.old_layers:
        if not net.layers and layer.HasField("oldest"):
            raise InvalidModel("It is of Caffe's first format; upgrade it with Caffe's upgrade_net_proto_binary.")
        blobs = [_stored(blob, arrays) for blob in layer.blobs]
        layer.ClearField("blobs")
        layers.append({"type": "" if net.layers else 0} | _plain(layer) | {"blobs": blobs})
    net.ClearField("layers")
    net.ClearField("old_layers")
    return _plain(net) | {"layers": layers}, arrays


def _parsed(name: str, content: bytes) -> Any:
    """The message of one of the kinds above; fields that are not described there are passed over."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    file = FileDescriptorProto(name="caffe.proto", package="caffe", syntax="proto2")
    for message, fields in _MESSAGES.items():
        described = file.message_type.add(name=message)
        for field, (number, kind) in fields.items():
            one = described.field.add(name=field, number=number)
            one.label = (
                FieldDescriptorProto.LABEL_REPEATED if kind.endswith("*") else FieldDescriptorProto.LABEL_OPTIONAL
            )
            if (kind := kind.removesuffix("*")) in _MESSAGES:
                one.type, one.type_name = FieldDescriptorProto.TYPE_MESSAGE, f".caffe.{kind}"
            else:
                one.type = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
    pool = DescriptorPool()
    pool.AddSerializedFile(file.SerializeToString())
    return GetMessageClass(pool.FindMessageTypeByName(f"caffe.{name}")).FromString(content)


def _plain(value: Any) -> Any:
    """A message as a dictionary of the fields that it sets, by name."""
    if hasattr(value, "ListFields"):
        return {field.name: _plain(content) for field, content in value.ListFields()}
    if isinstance(value, bytes):  # protobuf's way to give a text of which it cannot make one
        raise InvalidModel("A text in it is not UTF-8.")
    return value if isinstance(value, str | int | float) else [_plain(content) for content in value]


def _stored(blob: Any, arrays: dict[str, NDArray[Any]]) -> Part:
    """The shape of a BlobProto, new (``shape``) or old (num, channels, height, width), and the name of its numbers."""
    name = str(len(arrays))
    with np.errstate(over="ignore"):  # a double too large for a float becomes infinite, which is refused later
        arrays[name] = np.array(blob.doubles or blob.floats, np.float32)
    old = (blob.num, blob.channels, blob.height, blob.width)
    return {"shape": list(blob.shape.dim) if blob.HasField("shape") else old, "array": name}


if __name__ == "__main__":
    serve(_read, save_file)
