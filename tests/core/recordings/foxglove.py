"""MCAP files of Foxglove's messages, in protobuf and in JSON, for tests; their schemas are written out here."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterable, Mapping
from math import isfinite
from pathlib import Path
from typing import Any, Literal

from google.protobuf import descriptor_pool, json_format, message_factory
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.timestamp_pb2 import DESCRIPTOR as TIMESTAMP
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import Writer as McapWriter

SECOND = 1_000_000_000
Form = Literal["protobuf", "json"]

FIELDS: dict[str, dict[str, tuple[int, str]]] = {
    "Vector3": {"x": (1, "double"), "y": (2, "double"), "z": (3, "double")},
    "Quaternion": {"x": (1, "double"), "y": (2, "double"), "z": (3, "double"), "w": (4, "double")},
    "Pose": {"position": (1, "Vector3"), "orientation": (2, "Quaternion")},
    "CompressedImage": {
        "timestamp": (1, "time"),
        "frame_id": (4, "string"),
        "data": (2, "bytes"),
        "format": (3, "string"),
    },
    "RawImage": {
        "timestamp": (1, "time"),
        "frame_id": (7, "string"),
        "width": (2, "fixed32"),
        "height": (3, "fixed32"),
        "encoding": (4, "string"),
        "step": (5, "fixed32"),
        "data": (6, "bytes"),
    },
    "PoseInFrame": {"timestamp": (1, "time"), "frame_id": (2, "string"), "pose": (3, "Pose")},
    "LocationFix": {
        "timestamp": (6, "time"),
        "frame_id": (7, "string"),
        "latitude": (1, "double"),
        "longitude": (2, "double"),
        "altitude": (3, "double"),
    },
    "FrameTransform": {
        "timestamp": (1, "time"),
        "parent_frame_id": (2, "string"),
        "child_frame_id": (3, "string"),
        "translation": (4, "Vector3"),
        "rotation": (5, "Quaternion"),
    },
    "FrameTransforms": {"transforms": (1, "repeated FrameTransform")},
}
"""The numbers and types of the fields, as Foxglove has published them."""

KINDS = ("double", "string", "bytes", "fixed32")
SCALARS = {name: getattr(FieldDescriptorProto, f"TYPE_{name.upper()}") for name in KINDS}


def schema() -> bytes:
    """The descriptors of all messages and of what they depend on, in an order in which none can be added alone."""
    file = FileDescriptorProto(name="foxglove.proto", package="foxglove", syntax="proto3")
    file.dependency.append(TIMESTAMP.name)
    for name, fields in FIELDS.items():
        message = file.message_type.add(name=name)
        for field, (number, kind) in fields.items():
            bare = kind.removeprefix("repeated ")
            made = message.field.add(name=field, number=number, label=3 if bare != kind else 1)
            if bare in SCALARS:
                made.type = SCALARS[bare]
            else:
                made.type = FieldDescriptorProto.TYPE_MESSAGE
                made.type_name = ".google.protobuf.Timestamp" if bare == "time" else f".foxglove.{bare}"
    needed = FileDescriptorProto.FromString(TIMESTAMP.serialized_pb)
    return FileDescriptorSet(file=[file, needed]).SerializeToString()


def _classes() -> Callable[[str], Any]:
    pool = descriptor_pool.DescriptorPool()
    for file in reversed(FileDescriptorSet.FromString(schema()).file):
        pool.Add(file)
    return lambda kind: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{kind}"))


CLASS_OF = _classes()


def time(nanoseconds: int) -> dict[str, int]:
    """A time as Foxglove's JSON has it."""
    return {"sec": nanoseconds // SECOND, "nsec": nanoseconds % SECOND}


def written(form: Form, kind: str, fields: Mapping[str, Any]) -> bytes:
    """A message; its times are as ``time`` gives them, its bytes are bytes."""
    if form == "json":
        return json.dumps(fields, default=lambda data: base64.b64encode(data).decode()).encode()

    def plain(value: Any) -> Any:
        if isinstance(value, bytes):
            return base64.b64encode(value).decode()
        if isinstance(value, list):
            return [plain(one) for one in value]
        if isinstance(value, float) and not isfinite(value):
            return "Infinity"
        if isinstance(value, Mapping):
            if set(value) == {"sec", "nsec"}:
                return Timestamp(seconds=value["sec"], nanos=value["nsec"]).ToJsonString()
            return {name: plain(one) for name, one in value.items()}
        return value

    return bytes(json_format.ParseDict(plain(fields), CLASS_OF(kind)()).SerializeToString())


Message = tuple[str, str, int, Mapping[str, Any]]
"""Topic, type, when it was received, fields."""


def write(path: Path, form: Form, messages: Iterable[Message], data: bytes | None = None) -> Path:
    """An MCAP file of messages; ``data``: another schema for all, such as a damaged one."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channels: dict[str, int] = {}
        for topic, kind, received, fields in messages:
            if topic not in channels:
                definition = schema() if form == "protobuf" else b'{"type": "object"}'
                encoding = "protobuf" if form == "protobuf" else "jsonschema"
                number = writer.register_schema(f"foxglove.{kind}", encoding, definition if data is None else data)
                channels[topic] = writer.register_channel(topic, form, number)
            writer.add_message(channels[topic], received, written(form, kind, fields), received)
        writer.finish()  # type: ignore[no-untyped-call]
    return path
