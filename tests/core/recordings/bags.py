"""Bags for tests, written by rosbags and by mcap, each with the same messages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.service.scenes import jpeg

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
CAMERA, ODOMETRY = "/camera/image_raw/compressed", "/odom"
COMPRESSED, IMAGE = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"

ROS2, ROS1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))


@dataclass(frozen=True)
class Said:
    """A message: its topic, type, when it was received, and its stamp and fields; made for either ROS when written."""

    topic: str
    kind: str
    received: int
    make: Callable[[Any], Any]

    def cdr(self) -> bytes:
        return bytes(ROS2.serialize_cdr(self.make(ROS2), self.kind))

    def ros1(self) -> bytes:
        return bytes(ROS1.serialize_ros1(self.make(ROS1), self.kind))


def header(store: Any, stamp: int) -> Any:
    seconds, nanoseconds = divmod(stamp, SECOND)
    time = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    more = {"seq": 0} if store is ROS1 else {}
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id="camera", **more)


def compressed(stamp: int, data: bytes, topic: str = CAMERA, received: int | None = None, form: str = "jpeg") -> Said:
    """A picture as a compressed message."""

    def make(store: Any) -> Any:
        return store.types[COMPRESSED](header=header(store, stamp), format=form, data=np.frombuffer(data, np.uint8))

    return Said(topic, COMPRESSED, stamp if received is None else received, make)


def camera_info(stamp: int, topic: str = "/camera/camera_info", focal: float = 150.0) -> Said:
    """The intrinsics of a camera of 320 x 240 pixels, of which the frames are half as wide and high."""
    kind = "sensor_msgs/msg/CameraInfo"

    def make(store: Any) -> Any:
        region = store.types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        k = np.array([focal, 0, 159.5, 0, focal, 119.5, 0, 0, 1], np.float64)
        named = {"d": np.array([-0.2, 0.05, 0.001, 0, 0]), "k": k, "r": np.eye(3).ravel(), "p": np.zeros(12)}
        if store is ROS1:
            named = {name.upper(): value for name, value in named.items()}
        return store.types[kind](
            header=header(store, stamp), height=240, width=320, distortion_model="plumb_bob", **named,
            binning_x=2, binning_y=2, roi=region,
        )  # fmt: skip

    return Said(topic, kind, stamp, make)


def image(
    stamp: int, width: int, height: int, encoding: str, data: bytes, step: int, big: int = 0, topic: str = "/raw"
) -> Said:
    """A picture as raw pixels."""

    def make(store: Any) -> Any:
        return store.types[IMAGE](
            header=header(store, stamp),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=big,
            step=step,
            data=np.frombuffer(data, np.uint8),
        )

    return Said(topic, IMAGE, stamp, make)


def pose(store: Any, x: float, y: float, z: float, turn: Sequence[float]) -> Any:
    types = store.types
    return types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=x, y=y, z=z),
        orientation=types["geometry_msgs/msg/Quaternion"](x=turn[0], y=turn[1], z=turn[2], w=turn[3]),
    )


def moved(
    stamp: int, x: float, y: float, turn: Sequence[float] = (0, 0, 0, 1), kind: str = "nav_msgs/msg/Odometry"
) -> Said:
    """A pose: Odometry, PoseStamped or PoseWithCovarianceStamped."""

    def make(store: Any) -> Any:
        types, head, told = store.types, header(store, stamp), pose(store, x, y, 0.5, turn)
        if kind.endswith("PoseStamped"):
            return types[kind](header=head, pose=told)
        unsure = types["geometry_msgs/msg/PoseWithCovariance"](pose=told, covariance=np.zeros(36))
        if kind.endswith("PoseWithCovarianceStamped"):
            return types[kind](header=head, pose=unsure)
        still = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        twist = types["geometry_msgs/msg/TwistWithCovariance"](
            twist=types["geometry_msgs/msg/Twist"](linear=still, angular=still), covariance=np.zeros(36)
        )
        return types[kind](header=head, child_frame_id="base_link", pose=unsure, twist=twist)

    return Said(ODOMETRY, kind, stamp, make)


def fix(stamp: int, latitude: float, longitude: float, status: int = 0) -> Said:
    """A position from satellites; status -1 is none."""

    def make(store: Any) -> Any:
        return store.types["sensor_msgs/msg/NavSatFix"](
            header=header(store, stamp),
            status=store.types["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
            latitude=latitude,
            longitude=longitude,
            altitude=30.0,
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        )

    return Said("/fix", "sensor_msgs/msg/NavSatFix", stamp, make)


def walk(frames: int = 6) -> list[Said]:
    """A frame a second, and odometry ten times a second: a metre a second along x."""
    seen = [compressed(START + index * SECOND, jpeg(index)) for index in range(frames)]
    told = [moved(START + index * SECOND // 10, index / 10, 0.0) for index in range(10 * frames)]
    return sorted(seen + told, key=lambda said: said.received)


def write_rosbag2(path: Path, said: Iterable[Said], plugin: str = "sqlite3", packed: str = "none") -> Path:
    """A rosbag2 directory, by rosbags."""
    plugins = {"sqlite3": StoragePlugin.SQLITE3, "mcap": StoragePlugin.MCAP}
    writer = Ros2Writer(path, version=9, storage_plugin=plugins[plugin])
    if packed != "none":
        writer.set_compression(CompressionMode[packed.upper()], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for one in said:
            if one.topic not in connections:
                connections[one.topic] = writer.add_connection(one.topic, one.kind, typestore=ROS2)
            writer.write(connections[one.topic], one.received, one.cdr())
    return path


def write_mcap(
    path: Path,
    said: Iterable[Said],
    packing: CompressionType = CompressionType.ZSTD,
    chunks: bool = True,
    ros1: bool = False,
    chunk_size: int = 100_000,
) -> Path:
    """An MCAP file, by mcap."""
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=chunk_size, compression=packing, use_chunking=chunks)
        writer.start("ros1" if ros1 else "ros2")
        channels: dict[str, int] = {}
        for one in said:
            if one.topic not in channels:
                name = one.kind.replace("/msg/", "/") if ros1 else one.kind
                text, _ = (ROS1 if ros1 else ROS2).generate_msgdef(one.kind, ros_version=1 if ros1 else 2)
                definition = text.encode()
                schema = writer.register_schema(name, "ros1msg" if ros1 else "ros2msg", definition)
                channels[one.topic] = writer.register_channel(one.topic, "ros1" if ros1 else "cdr", schema)
            data = one.ros1() if ros1 else one.cdr()
            writer.add_message(channels[one.topic], one.received, data, one.received)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def write_ros1(path: Path, said: Iterable[Said], packing: str = "none") -> Path:
    """A ROS 1 bag, by rosbags."""
    writer = Ros1Writer(path)
    if packing != "none":
        writer.set_compression(Ros1Writer.CompressionFormat[packing.upper()])
    writer.chunk_threshold = 100_000
    with writer:
        connections: dict[str, Any] = {}
        for one in said:
            if one.topic not in connections:
                connections[one.topic] = writer.add_connection(one.topic, one.kind, typestore=ROS1)
            writer.write(connections[one.topic], one.received, one.ros1())
    return path


WRITERS: dict[str, Callable[[Path, Iterable[Said]], Path]] = {
    "sqlite": lambda folder, said: write_rosbag2(folder / "walk", said),
    "sqlite-message": lambda folder, said: write_rosbag2(folder / "walk", said, packed="message"),
    "sqlite-file": lambda folder, said: write_rosbag2(folder / "walk", said, packed="file"),
    "sqlite-file-alone": lambda folder, said: next(write_rosbag2(folder / "walk", said).glob("*.db3")),
    "mcap-of-rosbags": lambda folder, said: write_rosbag2(folder / "walk", said, "mcap"),
    "mcap-of-rosbags-packed": lambda folder, said: write_rosbag2(folder / "walk", said, "mcap", "storage"),
    "mcap-zstd": lambda folder, said: write_mcap(folder / "walk.mcap", said),
    "mcap-lz4": lambda folder, said: write_mcap(folder / "walk.mcap", said, CompressionType.LZ4),
    "mcap-plain": lambda folder, said: write_mcap(folder / "walk.mcap", said, CompressionType.NONE),
    "mcap-no-chunks": lambda folder, said: write_mcap(folder / "walk.mcap", said, chunks=False),
    "mcap-of-ros1": lambda folder, said: write_mcap(folder / "walk.mcap", said, ros1=True),
    "ros1": lambda folder, said: write_ros1(folder / "walk.bag", said),
    "ros1-bz2": lambda folder, said: write_ros1(folder / "walk.bag", said, "bz2"),
    "ros1-lz4": lambda folder, said: write_ros1(folder / "walk.bag", said, "lz4"),
}
"""Every kind of bag, by who writes it and how it is packed."""
