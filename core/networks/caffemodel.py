"""Caffe's files (Jia et al., 2014): the description and the weights of layers, and mean images.

A ``.caffemodel`` is a protobuf message with a description of each layer and its weights.  Two generations are read:
``layer`` (since 2014, types by name) and ``layers`` (before, types by number).
"""

from __future__ import annotations

import math
import mmap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidModel
from core.networks.protobuf import Message

# Numbers of the fields of caffe.NetParameter, LayerParameter (new) and V1LayerParameter (old) that are read.
_NET_OLD_LAYERS, _NET_INPUT, _NET_INPUT_DIM, _NET_INPUT_SHAPE, _NET_LAYERS = 2, 3, 4, 8, 100
_NEW = {
    "name": 1, "type": 2, "bottom": 3, "top": 4, "blobs": 7, "transform": 100, "convolution": 106, "data": 107,
    "image_data": 115, "normalization": 118, "pooling": 121, "relu": 123, "input": 143,
}  # fmt: skip
_OLD = {
    "bottom": 2, "top": 3, "name": 4, "type": 5, "blobs": 6, "convolution": 10, "data": 11, "image_data": 15,
    "normalization": 18, "pooling": 19, "relu": 30, "transform": 36,
}  # fmt: skip
_OLDEST_LAYER = 1  # in an old layer: all that it is, as files before 2013's end have it
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
    and writes.
    """

    name: str
    type: str
    bottoms: tuple[str, ...]
    tops: tuple[str, ...]
    content: Message
    fields: dict[str, int]

    def part(self, key: str) -> Message:
        """One of its groups of parameters, such as ``convolution``; empty if it has none."""
        return self.content.message(self.fields[key]) if key in self.fields else Message()

    def arrays(self) -> list[NDArray[np.float32]]:
        """Its weights, which are read from the disk only now."""
        blobs = self.content.messages(self.fields["blobs"])
        return [read_array(blob, f"Array {place} of {self}") for place, blob in enumerate(blobs)]

    def __str__(self) -> str:
        return f"layer {self.name!r} ({self.type})"


@dataclass(frozen=True)
class CaffeNetwork:
    """The contents of a ``.caffemodel``: its layers in order, and its input if that is described outside of them."""

    input: str | None
    input_shape: tuple[int, ...]
    layers: tuple[CaffeLayer, ...]


def read_caffemodel(path: Path) -> CaffeNetwork:
    """Read the description of a network; its weights stay on the disk until they are needed.

    Raises:
        InvalidModel: the file cannot be read or is damaged.
    """
    net = Message(map_file(path))
    fields, number = (_NEW, _NET_LAYERS) if _NET_LAYERS in net else (_OLD, _NET_OLD_LAYERS)
    shapes = net.messages(_NET_INPUT_SHAPE)
    return CaffeNetwork(
        input=next(iter(net.texts(_NET_INPUT)), None),
        input_shape=tuple(shapes[0].integers(1) if shapes else net.integers(_NET_INPUT_DIM)[:4]),
        layers=tuple(_read_layer(content, fields) for content in net.messages(number)),
    )


def _read_layer(content: Message, fields: dict[str, int]) -> CaffeLayer:
    if fields is _NEW:
        kind = content.text(fields["type"])
    elif _OLDEST_LAYER in content:
        raise InvalidModel("The model is of Caffe's first format; upgrade it with Caffe's upgrade_net_proto_binary.")
    else:
        code = content.integer(fields["type"])
        kind = _OLD_TYPES.get(code, f"number {code}")
    bottoms, tops = tuple(content.texts(fields["bottom"])), tuple(content.texts(fields["top"]))
    return CaffeLayer(content.text(fields["name"]), kind, bottoms, tops, content, fields)


def map_file(path: Path) -> memoryview:
    """Map a file into memory, without reading it yet.

    Raises:
        InvalidModel: there is no such file, or it is empty.
    """
    try:
        with path.open("rb") as file:
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except (OSError, ValueError) as error:
        raise InvalidModel(f"{path.name} cannot be read: {error}") from error


def read_array(blob: Message, title: str) -> NDArray[np.float32]:
    """The numbers of a BlobProto in its shape, new (``shape``) or old (num, channels, height, width).

    Raises:
        InvalidModel: the number of values does not fit the shape, or some are not finite.
    """
    if 7 in blob:
        shape = tuple(blob.message(7).integers(1))
    else:
        shape = (blob.integer(1), blob.integer(2), blob.integer(3), blob.integer(4))
    with np.errstate(over="ignore"):  # a double too large for a float is found below
        numbers = (blob.doubles(8) if 8 in blob else blob.floats(5)).astype(np.float32, copy=False)
    if len(shape) > 8 or math.prod(shape) != len(numbers):
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
        image = read_array(Message(map_file(path)), path.name)
    if image.ndim == 4 and len(image) == 1:
        image = image[0]
    if image.ndim not in (1, 3) or len(image) != 3 or not image.size:
        raise InvalidModel(f"{path.name} has the shape {image.shape}; a mean is of 3 or 3 x height x width numbers.")
    with np.errstate(all="ignore"):
        blue, green, red = image.reshape(3, -1).mean(axis=1, dtype=np.float64).tolist()
    if not np.isfinite([blue, green, red]).all():
        raise InvalidModel(f"{path.name} holds values that are not finite.")
    return blue, green, red
