"""A writer of small Caffe networks: as text for OpenCV, and in the two generations of binary files."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Layer = dict[str, Any]

# Writing protobuf messages


def varint(number: int) -> bytes:
    head, rest = number & 0x7F, number >> 7
    return bytes([head | 0x80]) + varint(rest) if rest else bytes([head])


def field(number: int, value: int | float | str | bytes) -> bytes:
    if isinstance(value, float):
        return varint(number << 3 | 5) + np.float32(value).tobytes()
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    content = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(content)) + content


def repeated(number: int, values: list[Any]) -> bytes:
    return b"".join(field(number, value) for value in values)


# Writing a network

PARTS = {  # of a layer: number in the new and in the old generation, numbers of its fields
    "convolution_param": (106, 10, {
        "num_output": 1, "bias_term": 2, "pad": 3, "kernel_size": 4, "group": 5, "stride": 6, "pad_h": 9, "pad_w": 10,
        "kernel_h": 11, "kernel_w": 12, "stride_h": 13, "stride_w": 14, "axis": 16, "dilation": 18,
    }),
    "pooling_param": (121, 19, {
        "pool": 1, "kernel_size": 2, "stride": 3, "pad": 4, "kernel_h": 5, "kernel_w": 6, "stride_h": 7, "stride_w": 8,
        "global_pooling": 12, "round_mode": 13,
    }),
    "lrn_param": (118, 18, {"local_size": 1, "alpha": 2, "beta": 3, "norm_region": 4, "k": 5}),
    "relu_param": (123, 30, {"negative_slope": 1}),
    "inner_product_param": (117, 17, {"num_output": 1}),
    "transform_param": (100, 36, {"scale": 1, "crop_size": 3, "mean_value": 5}),
    "data_param": (107, 11, {"scale": 2, "crop_size": 5}),
}  # fmt: skip
WORDS = {("pool", 0): "MAX", ("pool", 1): "AVE", ("round_mode", 1): "FLOOR", ("bias_term", 0): "false"}
OLD_TYPES = {
    "Convolution": 4, "Data": 5, "Dropout": 6, "InnerProduct": 14, "LRN": 15, "Pooling": 17, "ReLU": 18,
    "SoftmaxWithLoss": 21, "Split": 22, "Eltwise": 25,
}  # fmt: skip


def layer(name: str, kind: str, bottom: str = "", top: str = "", blobs: tuple[Array, ...] = (), **parts: Any) -> Layer:
    top = top or name
    return {"name": name, "type": kind, "bottom": bottom.split(), "top": top.split(), "blobs": blobs, "parts": parts}


def prototxt(layers: list[Layer], shape: tuple[int, ...]) -> bytes:
    lines = ['input: "data"', *(f"input_dim: {side}" for side in shape)]
    for one in layers:
        lines.append(f'layer {{ name: "{one["name"]}" type: "{one["type"]}"')
        lines += [f'{end}: "{blob}"' for end in ("bottom", "top") for blob in one[end]]
        for part, values in one["parts"].items():
            pairs = [(key, one) for key, value in values.items() for one in (value if type(value) is list else [value])]
            lines.append(f"{part} {{ {' '.join(f'{key}: {WORDS.get((key, one), one)}' for key, one in pairs)} }}")
        lines.append("}")
    return "\n".join(lines).encode()


def blob(values: Array, form: str) -> bytes:
    """A BlobProto as newer and older versions of Caffe write it."""
    sides = [1] * (4 - values.ndim) + list(values.shape)
    shape = repeated(1, sides[:1]) + repeated(2, sides[1:2]) + repeated(3, sides[2:3]) + repeated(4, sides[3:4])
    if form == "old":
        return shape + field(5, values.tobytes())
    if form == "unpacked":
        return b"".join(field(5, float(value)) for value in values.reshape(-1)) + shape
    packed = b"".join(varint(side) for side in values.shape)
    if form == "double":
        return field(7, field(1, packed)) + field(8, values.astype("<f8").tobytes())
    data = values.tobytes()  # in two stretches, as a writer may send it
    return field(7, repeated(1, list(values.shape))) + field(5, data[:4]) + field(5, data[4:])


def caffemodel(layers: list[Layer], generation: str = "new", form: str = "new", start: bytes = b"") -> bytes:
    content = field(1, "small") + start
    old = generation == "old"
    for one in layers:
        written = field(4 if old else 1, one["name"]) + field(
            *((5, OLD_TYPES[one["type"]]) if old else (2, one["type"]))
        )
        written += repeated(2 if old else 3, one["bottom"]) + repeated(3 if old else 4, one["top"])
        for part, values in one["parts"].items():
            new_number, old_number, fields = PARTS[part]
            inner = b"".join(
                repeated(fields[key], value if isinstance(value, list) else [value]) for key, value in values.items()
            )
            written += field(old_number if old else new_number, inner)
        written += b"".join(field(6 if old else 7, blob(values, form)) for values in one["blobs"])
        content += field(2 if old else 100, written)
    return content


def input_dim(*shape: int) -> bytes:
    return field(3, "data") + repeated(4, list(shape))


def convolution(
    name: str, bottom: str, channels: int, count: int, kernel: int, bias: bool = True, **more: Any
) -> Layer:
    groups = more.get("group", 1)
    fan = channels // groups * kernel * kernel
    random = np.random.default_rng(len(name) + fan)
    weight = (random.standard_normal((count, channels // groups, kernel, kernel)) / math.sqrt(fan)).astype(np.float32)
    blobs = (weight, random.uniform(0, 1, count).astype(np.float32)) if bias else (weight,)
    sides = {} if "kernel_h" in more else {"kernel_size": kernel}
    more |= {} if bias else {"bias_term": 0}
    return layer(name, "Convolution", bottom, blobs=blobs, convolution_param={"num_output": count} | sides | more)


def relu(name: str, blob_name: str, **more: Any) -> Layer:
    return layer(name, "ReLU", blob_name, blob_name, **more)


def small_network(norm_first: bool = False) -> list[Layer]:
    """CaffeNet in little: groups, normalizations, ceil pooling of odd sizes, in-place rectifiers, six convolutions."""
    lrn = {"local_size": 5, "alpha": 0.4, "beta": 0.75}
    pool = {"pool": 0, "kernel_size": 3, "stride": 2}
    shrink = ("LRN", {"lrn_param": lrn}), ("Pooling", {"pooling_param": pool})
    first, second = shrink if norm_first else shrink[::-1]
    return [
        convolution("conv1", "data", 3, 8, 5, stride=2),
        relu("relu1", "conv1"),
        layer("shrink1a", first[0], "conv1", **first[1]),
        layer("shrink1b", second[0], "shrink1a", **second[1]),
        convolution("conv2", "shrink1b", 8, 12, 5, pad=2, group=2),
        relu("relu2", "conv2"),
        layer("pool2", "Pooling", "conv2", pooling_param={"pool": 1, "kernel_size": 3, "stride": 2, "pad": 1}),
        layer("norm2", "LRN", "pool2", lrn_param={"local_size": 3, "alpha": 2.0, "beta": 0.5}),
        convolution("conv3", "norm2", 12, 10, 3, pad=[1, 1], stride_h=1, stride_w=1),
        relu("relu3", "conv3"),
        convolution("conv4", "conv3", 10, 10, 3, pad_h=1, pad_w=1, kernel_h=3, kernel_w=3, group=2),
        relu("relu4", "conv4", relu_param={"negative_slope": 0.1}),
        convolution("conv5", "conv4", 10, 6, 3, bias=False, pad=1),
        relu("relu5", "conv5"),
        layer("pool5", "Pooling", "conv5", pooling_param={"kernel_h": 2, "kernel_w": 2, "stride_h": 2, "stride_w": 2}),
        convolution("conv6", "pool5", 6, 4, 1),
        relu("relu6", "conv6"),
    ]  # fmt: skip


HEAD = [
    layer("drop6", "Dropout", "conv6", "conv6"),
    layer("fc7", "InnerProduct", "conv6", blobs=(np.ones((2, 4), np.float32),), inner_product_param={"num_output": 2}),
    relu("relu7", "fc7"),
    layer("loss", "SoftmaxWithLoss", "fc7 label", "loss"),
]
