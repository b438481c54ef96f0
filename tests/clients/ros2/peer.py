"""What a robot has beside the node: it plays bags, records what the node publishes, and calls its services.

It runs in .venv-ros, takes one JSON object a line from standard input, and answers each with one on standard output.
"""

from __future__ import annotations

import json
import math
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, NavSatFix
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

KINDS = {
    kind.__name__: kind
    for kind in (CompressedImage, Image, CameraInfo, Odometry, String, PoseWithCovarianceStamped, TFMessage)
    if kind is not None
}
TRANSITIONS = {
    "configure": 1,
    "cleanup": 2,
    "activate": 3,
    "deactivate": 4,
    "shutdown unconfigured": 5,
    "shutdown inactive": 6,
    "shutdown active": 7,
}
GOALS = {
    "configure": "inactive",
    "cleanup": "unconfigured",
    "activate": "active",
    "deactivate": "inactive",
    "shutdown unconfigured": "finalized",
    "shutdown inactive": "finalized",
    "shutdown active": "finalized",
}
"""The states to which transitions lead."""
BAG_TYPES = {
    "CompressedImage": "sensor_msgs/msg/CompressedImage",
    "CameraInfo": "sensor_msgs/msg/CameraInfo",
    "Odometry": "nav_msgs/msg/Odometry",
}
PATIENCE = 40.0
TRIES = 4
"""How often a service is called that only tells something: its answer is lost if it does not know its caller yet."""


class Peer:
    """The process's node, and what it has heard."""

    def __init__(self) -> None:
        self.node: Any = Node("peer")
        self.heard: dict[str, list[dict[str, Any]]] = {}
        self._lock = threading.Lock()
        self._publishers: dict[str, Any] = {}
        self._subscriptions: dict[str, Any] = {}
        self._clients: dict[str, Any] = {}
        self._playing: threading.Thread | None = None
        # Made long before they are called: these are called once, and the answer is lost if the node does not know its
        # caller yet.
        for service in ("create_map", "enrol_here", "relocalize"):
            self._client(Trigger, f"/placerec/{service}")
        self._client(SetBool, "/placerec/enrol_keyframes")

    def note(self, topic: str, entry: dict[str, Any]) -> None:
        with self._lock:
            self.heard.setdefault(topic, []).append({"at": time.time(), **entry})

    # ---- commands

    def sleep(self, seconds: float) -> dict[str, Any]:
        """Wait."""
        time.sleep(seconds)
        return {}

    def listen(self, topic: str, durable: bool = False, node: str = "placerec") -> dict[str, Any]:
        """Record a topic of the node, such as answer, or one of all, /diagnostics or /tf."""
        known: dict[str, tuple[Any, Callable[[Any], dict[str, Any]]]] = {
            "answer": (String, lambda message: json.loads(message.data)),
            "pose": (PoseWithCovarianceStamped, pose_of),
            "map_to_odom": (TransformStamped, transform_of),
            "/initialpose": (PoseWithCovarianceStamped, pose_of),
            "/tf": (TFMessage, lambda message: transform_of(message.transforms[0])),
            "fix": (NavSatFix, fix_of),
            "filtered_pose": (PoseWithCovarianceStamped, pose_of),
            "annotated/compressed": (CompressedImage, picture_of),
            "/diagnostics": (DiagnosticArray, diagnostics_of),
        }
        kind, show = known[topic]
        qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
        if durable:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        full = topic if topic.startswith("/") else f"/{node}/{topic}"
        if topic in self._subscriptions:
            self.deafen(topic)
        self._subscriptions[topic] = self.node.create_subscription(
            kind, full, lambda message: self.note(topic, show(message)), qos
        )
        return {}

    def knows_tf(self) -> dict[str, Any]:
        """Whether the message of /tf could be built."""
        return {"known": TFMessage is not None}

    def deafen(self, topic: str) -> dict[str, Any]:
        """End the recording of a topic, if there is one."""
        if (made := self._subscriptions.pop(topic, None)) is not None:
            self.node.destroy_subscription(made)
        return {}

    def take(self, topic: str) -> dict[str, Any]:
        """What was heard since the last time."""
        with self._lock:
            return {"heard": self.heard.pop(topic, [])}

    def advertise(self, topic: str, kind: str, reliable: bool = False, durable: bool = False) -> dict[str, Any]:
        """Make a publisher."""
        reliability = ReliabilityPolicy.RELIABLE if reliable or durable else ReliabilityPolicy.BEST_EFFORT
        qos = QoSProfile(depth=10, reliability=reliability)
        if durable:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        self.withdraw(topic)
        until = time.monotonic() + PATIENCE
        while topic not in self._publishers:  # the middleware takes a moment to forget another type
            try:
                self._publishers[topic] = self.node.create_publisher(KINDS[kind], topic, qos)
            except rclpy_implementation.RCLError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.1)
        return {}

    def withdraw(self, topic: str) -> dict[str, Any]:
        """Take a publisher back."""
        if topic in self._publishers:
            self.node.destroy_publisher(self._publishers.pop(topic))
        return {}

    def subscribers(self, topic: str) -> dict[str, Any]:
        """How many subscribe to a topic of this peer."""
        return {"subscribers": self._publishers[topic].get_subscription_count()}

    def listeners(self, topic: str) -> dict[str, Any]:
        """To how many publishers the recording of a topic is connected."""
        return {"publishers": self._subscriptions[topic].get_publisher_count()}

    def publishers(self) -> dict[str, Any]:
        """To how many publishers of the node each of this peer's recordings is connected."""
        counts = {topic: made.get_publisher_count() for topic, made in self._subscriptions.items()}
        return {"publishers": {topic: count for topic, count in counts.items() if not topic.startswith("/")}}

    def publish(self, topic: str, kind: str, **fields: Any) -> dict[str, Any]:
        """Publish one message; bytes are named by the path of a file."""
        self._publishers[topic].publish(message_of(kind, fields))
        return {"at": time.time()}

    def ask(self, topic: str, kind: str, **fields: Any) -> dict[str, Any]:
        """Publish one message, and wait for the node's answer to it; the seconds from the one to the other."""
        message = message_of(kind, fields)
        with self._lock:
            self.heard.pop("answer", None)
        began = time.time()
        self._publishers[topic].publish(message)
        while time.time() < began + PATIENCE:
            with self._lock:
                heard = self.heard.get("answer", [])
                if heard and abs(heard[-1]["stamp"] - fields["stamp"]) < 1e-3:
                    return {"seconds": heard[-1]["at"] - began, "answer": heard[-1]}
            time.sleep(0.002)
        raise TimeoutError("the node did not answer")

    def write_bag(self, path: str, messages: list[dict[str, Any]]) -> dict[str, Any]:
        """Write a bag; each message has a topic, a kind and a stamp in seconds."""
        store = get_typestore(Stores.ROS2_KILTED)
        connections: dict[str, Any] = {}
        with Writer(Path(path), version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            for fields in messages:
                topic, kind = fields.pop("topic"), fields.pop("kind")
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, BAG_TYPES[kind], typestore=store)
                stamp = int(fields["stamp"] * 1e9)
                writer.write(connections[topic], stamp, serialize_message(message_of(kind, fields)))
        return {}

    def play(self, path: str, rate: float = 1.0, wait: bool = False, settle: float = 0.0) -> dict[str, Any]:
        """Publish a bag's messages at the pace of their times, so many times faster."""
        with Reader(Path(path)) as reader:
            for connection in reader.connections:
                if connection.topic not in self._publishers:
                    self.advertise(connection.topic, connection.msgtype.rpartition("/")[2])
        self._playing = threading.Thread(target=self._play, args=(path, rate), daemon=True)
        self._playing.start()
        return self.played() if wait else {}

    def _play(self, path: str, rate: float) -> None:
        with Reader(Path(path)) as reader:
            began, first = time.monotonic(), None
            for connection, stamp, raw in reader.messages():
                first = stamp if first is None else first
                due = began + (stamp - first) / 1e9 / rate
                time.sleep(max(0.0, due - time.monotonic()))
                kind = KINDS[connection.msgtype.rpartition("/")[2]]
                message = deserialize_message(bytes(raw), kind)
                now = time.time()
                self._publishers[connection.topic].publish(message)
                if kind is CompressedImage:
                    self.note("played", {"stamp": stamp_of(message), "published": now})

    def played(self) -> dict[str, Any]:
        """Wait until the bag has been played."""
        assert self._playing is not None
        self._playing.join()
        return {}

    def call(self, service: str, patience: float = PATIENCE) -> dict[str, Any]:
        """Call one of the node's own services."""
        done = self._call(Trigger, f"/placerec/{service}", Trigger.Request(), patience)
        return {"success": done.success, "message": done.message}

    def switch(self, service: str, on: bool) -> dict[str, Any]:
        """Call one of the node's own services that switches something on or off."""
        done = self._call(SetBool, f"/placerec/{service}", SetBool.Request(data=on))
        return {"success": done.success, "message": done.message}

    def transition(self, name: str, node: str = "placerec") -> dict[str, Any]:
        """Ask a node for a transition; how long it took."""
        request = ChangeState.Request()
        request.transition.id = TRANSITIONS[name]
        began = time.monotonic()
        try:
            done = self._call(ChangeState, f"/{node}/change_state", request, PATIENCE / 2)
        except TimeoutError:  # the answer is lost if the node does not know its caller yet
            told = self.state(node)
            if told["state"] != GOALS.get(name) or told["seconds"] > PATIENCE / TRIES:
                raise
            return {"success": True, "seconds": told["seconds"]}
        return {"success": done.success, "seconds": time.monotonic() - began}

    def set(self, values: dict[str, Any]) -> dict[str, Any]:
        """Set parameters of the node; why each was refused, if so."""
        request = SetParameters.Request()
        request.parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        done = self._call(SetParameters, "/placerec/set_parameters", request, tries=TRIES)
        return {"refused": [result.reason for result in done.results if not result.successful]}

    def get(self, names: list[str], node: str) -> dict[str, Any]:
        """The values of parameters of a node, by their names; of strings and numbers."""
        done = self._call(GetParameters, f"/{node}/get_parameters", GetParameters.Request(names=names), tries=TRIES)
        values = {one: parameter_value_to_python(value) for one, value in zip(names, done.values, strict=True)}
        return {"values": values}

    def describe(self, names: list[str]) -> dict[str, Any]:
        """What the node says of its parameters."""
        request = DescribeParameters.Request(names=names)
        done = self._call(DescribeParameters, "/placerec/describe_parameters", request, tries=TRIES)
        return {"descriptions": {one.name: one.description for one in done.descriptors}}

    def state(self, node: str = "placerec") -> dict[str, Any]:
        """The state of a node, and how long it took to say so."""
        began = time.monotonic()
        done = self._call(GetState, f"/{node}/get_state", GetState.Request(), tries=TRIES)
        return {"state": done.current_state.label, "seconds": time.monotonic() - began}

    def _client(self, kind: Any, name: str) -> Any:
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        return self._clients[name]

    def _call(self, kind: Any, name: str, request: Any, patience: float = PATIENCE, tries: int = 1) -> Any:
        client = self._client(kind, name)
        if not client.wait_for_service(patience):
            raise TimeoutError(f"no service {name}")
        for _ in range(tries):
            future, done = client.call_async(request), threading.Event()
            future.add_done_callback(lambda _, done=done: done.set())
            if done.wait(patience / tries):
                return future.result()
        raise TimeoutError(f"{name} did not answer in {patience} s")


def message_of(kind: str, fields: dict[str, Any]) -> Any:
    """A message of the fields that matter in the tests."""
    message = KINDS[kind]()
    if kind == "String":
        message.data = fields.get("data", "")
        return message
    stamp = fields.get("stamp", 0)
    if kind == "TFMessage":
        transform = TransformStamped(child_frame_id=fields["child"])
        transform.header.frame_id = fields["parent"]
        moved, turned = transform.transform.translation, transform.transform.rotation
        moved.x, moved.y, moved.z = map(float, fields["moved"])
        turned.x, turned.y, turned.z, turned.w = map(float, fields["turned"])
        message.transforms = [transform]
        return message
    message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), round(1e9 * (stamp - int(stamp)))
    message.header.frame_id = fields.get("frame_id", "camera")
    if kind == "CompressedImage":
        message.format = fields.get("format", "jpeg")
        message.data = Path(fields["file"]).read_bytes()
    elif kind == "Image":
        message.height, message.width, message.encoding = fields["height"], fields["width"], fields["encoding"]
        message.data = Path(fields["file"]).read_bytes()
        message.step = fields.get("step", len(message.data) // message.height)
    elif kind == "CameraInfo":
        message.width, message.height = fields["width"], fields["height"]
        message.k = [fields["fx"], 0.0, fields["cx"], 0.0, fields["fy"], fields["cy"], 0.0, 0.0, 1.0]
        message.distortion_model, message.d = fields.get("distortion_model", "plumb_bob"), fields.get("d", [0.0] * 5)
    else:
        message.header.frame_id = fields.get("frame_id", "map" if kind == "PoseWithCovarianceStamped" else "odom")
        if kind == "Odometry":
            message.child_frame_id = "base_link"
        else:
            message.pose.covariance[0] = message.pose.covariance[7] = fields.get("variance", 0.25)
            message.pose.covariance[35] = 0.07
        pose, yaw = message.pose.pose, math.radians(fields.get("heading", 0.0))
        pose.position.x, pose.position.y = float(fields["x"]), float(fields["y"])
        pose.orientation.z, pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return message


def stamp_of(message: Any) -> float:
    return float(message.header.stamp.sec + message.header.stamp.nanosec * 1e-9)


def pose_of(message: Any) -> dict[str, Any]:
    pose = message.pose.pose
    return {
        "stamp": stamp_of(message),
        "frame": message.header.frame_id,
        "x": pose.position.x,
        "y": pose.position.y,
        "z": pose.position.z,
        "heading": math.degrees(2 * math.atan2(pose.orientation.z, pose.orientation.w)) % 360,
        "covariance": list(map(float, message.pose.covariance)),
    }


def fix_of(message: Any) -> dict[str, Any]:
    return {
        "stamp": stamp_of(message),
        "frame": message.header.frame_id,
        "latitude": message.latitude,
        "longitude": message.longitude,
        "altitude": None if math.isnan(message.altitude) else message.altitude,
        "covariance": list(map(float, message.position_covariance)),
    }


def transform_of(message: Any) -> dict[str, Any]:
    moved, turned = message.transform.translation, message.transform.rotation
    yaw = math.degrees(2 * math.atan2(turned.z, turned.w)) % 360
    frames = {"frame": message.header.frame_id, "child": message.child_frame_id}
    return {"stamp": stamp_of(message), "x": moved.x, "y": moved.y, "heading": yaw, **frames}


def picture_of(message: Any) -> dict[str, Any]:
    return {"stamp": stamp_of(message), "format": message.format, "start": bytes(message.data[:8]).hex()}


def diagnostics_of(message: Any) -> dict[str, Any]:
    (status,) = message.status
    level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
    values = {one.key: one.value for one in status.values}
    return {"level": level, "message": status.message, "name": status.name, "values": values}


def main() -> None:
    rclpy.init()
    peer = Peer()
    executor = SingleThreadedExecutor()
    executor.add_node(peer.node)
    spinning = threading.Thread(target=executor.spin)
    spinning.start()
    for line in sys.stdin:
        order = json.loads(line)
        try:
            answer = getattr(peer, order.pop("do"))(**order)
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)
    executor.shutdown()
    rclpy.try_shutdown()
    spinning.join()


if __name__ == "__main__":
    main()
