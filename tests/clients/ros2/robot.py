"""A robot for tests: the node and a peer, each a process of .venv-ros, and pictures of a walk."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from core.frames.preprocessing import Pixels
from placerec_ros.parameters import PARAMETERS
from tests.service.scenes import encoded, scene, seen_again
from tests.service.server import ROOT, Server
from tests.watch import PROXIES

VENV = ROOT / ".venv-ros"
PYTHON = VENV / "bin" / "python"
PEER = Path(__file__).with_name("peer.py")
PATIENCE = 30.0

STEPS, SHIFT, WIDTH = 6, 24, 320
"""Frames cut out of one picture, pixels from one to the next, and pixels of a frame."""


def walk(first: int = 700, pictures: int = 3) -> list[Pixels]:
    """The frames of a walk along drawn walls: the camera moves sideways past each."""
    walls = [scene(first + number, WIDTH + SHIFT * STEPS, 240) for number in range(pictures)]
    return [
        np.ascontiguousarray(wall[:, SHIFT * step : SHIFT * step + WIDTH]) for wall in walls for step in range(STEPS)
    ]


def walked_again(frames: list[Pixels]) -> list[bytes]:
    """The same walk in another light, as JPEG files."""
    return [encoded(seen_again(frame, number)) for number, frame in enumerate(frames)]


def ros_environment(**more: str) -> dict[str, str]:
    """The environment of processes of .venv-ros: ROS keeps to this machine and logs as it goes; there is no proxy."""
    dropped = ("PLACEREC_", "ROS_", "RMW_", *PROXIES)
    kept = {name: value for name, value in os.environ.items() if not name.startswith(dropped)}
    own = {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),  # tests that run beside these have nodes of the same name
        "RCUTILS_LOGGING_BUFFERED_STREAM": "0",
        "PYTHONUNBUFFERED": "1",
    }
    return {**kept, **own, **more}


class Node:
    """The node's process.

    Args:
        folder: for its log.
        parameters: its parameters.
        name: of the node.
        wrapper: words before the command.
        arguments: of ROS, besides, such as those of a namespace.
        environment: variables, such as PLACEREC_KEY.
    """

    def __init__(
        self,
        folder: Path,
        parameters: Mapping[str, object],
        name: str = "placerec",
        wrapper: Sequence[str] = (),
        arguments: Sequence[str] = (),
        **environment: str,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.log_file = folder / "node.log"
        words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={_yaml(value)}")]
        command = [*wrapper, str(PYTHON), "-m", "placerec_ros.node", "--ros-args", "-r", f"__node:={name}"]
        command += [*words, *arguments]
        with self.log_file.open("ab") as log:
            variables = ros_environment(ROS_LOG_DIR=str(folder / "ros"), **environment)
            self.process = subprocess.Popen(command, env=variables, stdout=log, stderr=log, cwd=folder)

    def log(self) -> str:
        """What it has logged."""
        return self.log_file.read_text(errors="replace")

    def stop(self) -> int:
        """End it as launch would; the exit status."""
        self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(60)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise AssertionError(f"the node does not end:\n{self.log()[-3000:]}") from None


def _yaml(value: object) -> str:
    return json.dumps(value)


class Peer:
    """The peer's process; each method of ``peer.py`` is called by :meth:`do`."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._log = (folder / "peer.log").open("ab")
        self.process = subprocess.Popen(
            [str(PYTHON), str(PEER)],
            env=ros_environment(ROS_LOG_DIR=str(folder / "ros")),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
        )

    def do(self, what: str, **words: object) -> dict[str, Any]:
        """Have the peer do something; what it answers."""
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps({"do": what, **words}) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        assert line, "the peer has ended"
        answer: dict[str, Any] = json.loads(line)
        assert "error" not in answer, answer["error"]
        return answer

    def hears(self, count: int) -> None:
        """Wait until all that it records of the node has so many publishers; what came before would be lost."""
        until(lambda: set(self.do("publishers")["publishers"].values()) <= {count})

    def connected(self, topic: str) -> None:
        """Wait until the node subscribes; then a moment more, for it learns of this publisher at about that time."""
        until(lambda: self.do("subscribers", topic=topic)["subscribers"])
        time.sleep(0.2)

    def take(self, topic: str) -> list[dict[str, Any]]:
        """What it heard on a topic since the last time."""
        heard: list[dict[str, Any]] = self.do("take", topic=topic)["heard"]
        return heard

    def stop(self) -> None:
        """End it."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:
            self.process.kill()
        self._log.close()


def until(done: Callable[[], Any], patience: float = PATIENCE) -> Any:
    """Wait until something is true; what it was."""
    end = time.monotonic() + patience
    while not (found := done()):
        assert time.monotonic() < end, f"not in {patience} s"
        time.sleep(0.05)
    return found


@dataclass
class Site:
    """A service with keys, a peer, a node, and the frames of a walk: as enrolled, and as the robot sees them."""

    folder: Path
    server: Server
    keys: dict[str, str]
    frames: list[Pixels]
    again: list[bytes]
    peer: Peer = field(init=False)
    node: Node = field(init=False)

    def start_peers(self) -> None:
        """Start the processes of ROS."""
        self.peer = Peer(self.folder / "peer")
        self.node = Node(self.folder / "node", {})

    def stop(self) -> None:
        """End all processes."""
        try:
            assert self.node.stop() == 0, self.node.log()[-3000:]
            for key in self.keys.values():
                assert key not in self.node.log()
        finally:
            self.peer.stop()
            self.server.stop()

    @property
    def url(self) -> str:
        """The address of the service."""
        return f"http://127.0.0.1:{self.server.port}"

    def enrol(self, map_id: str, count: int = 99) -> None:
        """Make a map of the walk: a metre from frame to frame along +x."""
        self.server.create_map(map_id, same_place_radius=1.5)
        for number, frame in enumerate(self.frames[:count]):
            pose = {"x": number, "y": 0, "heading": 0}
            done = self.server.enrol(map_id, f"p{number:02d}", encoded(frame), sequence="walk", **pose)
            assert done.status_code == 201, done.text

    def file(self, name: str, data: bytes) -> str:
        """The path of a new file."""
        path = self.folder / name
        path.write_bytes(data)
        return str(path)


class Robot:
    """The node as a test uses it."""

    BASE = 1_763_800_000.0
    """The stamp of the first frame, in seconds."""

    def __init__(self, site: Site) -> None:
        self.site, self.peer = site, site.peer
        self.frame = 0
        self._log_start = len(site.node.log())
        for topic in ("answer", "pose", "map_to_odom", "/diagnostics"):
            self.peer.do("listen", topic=topic)
            self.peer.take(topic)

    def begin(self, active: bool = True, role: str = "enrol", **parameters: object) -> None:
        """Configure and activate the node, with all parameters that are not given at their defaults."""
        defaults = {one.name: one.default for one in PARAMETERS}
        quiet = {"use_camera_info": False, "deadline": 20.0, "queue_length": 100, "image_type": "compressed"}
        key = str(self.site.folder / f"{role}.key") if role else ""
        own = {"url": self.site.url, "map": "walk", "key_file": key}
        assert self.peer.do("set", values={**defaults, **quiet, **own, **parameters})["refused"] == []
        self.peer.hears(0)
        assert self.transition("configure")
        self.peer.hears(1)
        if active:
            assert self.transition("activate")

    def connected(self, topic: str = "/image") -> None:
        """Wait until the node subscribes to a topic of the peer."""
        self.peer.connected(topic)

    def transition(self, name: str) -> bool:
        """Ask the node for a transition, which takes no longer than a moment."""
        done = self.peer.do("transition", name=name)
        assert done["seconds"] < 15, "the node waited for something"
        return bool(done["success"])

    @property
    def state(self) -> str:
        """The node's state."""
        return str(self.peer.do("state")["state"])

    def end(self) -> None:
        """Take the node back to where it is not configured, whatever the test left."""
        if self.state == "active":
            assert self.transition("deactivate")
        if self.state == "inactive":
            assert self.transition("cleanup")
        for topic in (
            *("answer", "pose", "filtered_pose", "fix", "map_to_odom"),
            "annotated/compressed",
            "/tf",
            "/diagnostics",
        ):
            self.peer.do("deafen", topic=topic)
            self.peer.take(topic)
        self.peer.do("deafen", topic="/initialpose")
        self.peer.take("/initialpose")
        for topic in ("/image", "/image/compressed", "/camera_info", "/odom", "/initialpose", "/tf_static"):
            self.peer.do("withdraw", topic=topic)

    def look(self, data: bytes | None = None, number: int | None = None, **fields: object) -> float:
        """Publish one frame of the walk, or a picture; its stamp."""
        index = self.frame if number is None else number
        path = self.site.folder / f"again-{index:02d}.jpg"
        file = str(path) if data is None else self.site.file(f"picture-{self.frame}", data)
        stamp = self.BASE + 0.1 * self.frame
        self.frame += 1
        self.peer.do("publish", topic="/image", kind="CompressedImage", stamp=stamp, file=file, **fields)
        return stamp

    def odometry(self, x: float, y: float, heading: float, settle: float = 0.1) -> float:
        """Publish odometry of the moment of the next frame, give it so many seconds to arrive first; its stamp."""
        stamp = self.BASE + 0.1 * self.frame
        self.peer.do("publish", topic="/odom", kind="Odometry", stamp=stamp, x=x, y=y, heading=heading)
        self.peer.do("sleep", seconds=settle)
        return stamp

    def answers(self, count: int = 1) -> list[dict[str, Any]]:
        """The next so many answers."""
        heard: list[dict[str, Any]] = []

        def enough() -> bool:
            heard.extend(self.peer.take("answer"))
            return len(heard) >= count

        until(enough)
        assert len(heard) == count
        return heard

    def answers_to(self, pictures: list[bytes]) -> list[dict[str, Any]]:
        """Show pictures one after the other; the answers."""
        answers = []
        for data in pictures:
            self.look(data)
            answers += self.answers()
        return answers

    def answers_settled(self) -> None:
        """Wait until all frames that were published have been answered."""
        quiet = 0
        while quiet < 3:
            self.peer.do("sleep", seconds=0.15)
            quiet = 0 if self.peer.take("answer") else quiet + 1

    def enrol_here(self, show: Callable[[], object]) -> dict[str, Any]:
        """Show the node something and have it enrolled; show it again if it was no longer present when it was to be."""

        def told() -> dict[str, Any] | None:
            show()
            done = self.peer.do("call", service="enrol_here")
            return None if "No image has come" in done["message"] else done

        done: dict[str, Any] = until(told)
        return done

    def asked(self, number: int) -> dict[str, Any]:
        """Publish a frame of the walk, and wait for its answer; answers to frames before it are passed over."""
        stamp = self.look(number=number)

        def answered() -> dict[str, Any] | None:
            return next((one for one in self.peer.take("answer") if abs(one["stamp"] - stamp) < 1e-3), None)

        found: dict[str, Any] = until(answered)
        return found

    def drive(self, start: int, stop: int) -> dict[str, Any]:
        """Let the robot see frames of the walk, one after the other; the last answer."""
        answer: dict[str, Any] = {}
        for number in range(start, stop):
            answer = self.asked(number)
        return answer

    def says(self, text: str) -> dict[str, Any]:
        """Wait until the diagnostics say something; the status."""

        def heard() -> dict[str, Any] | None:
            return next((one for one in self.peer.take("/diagnostics") if text in one["message"]), None)

        found: dict[str, Any] = until(heard)
        return found

    def log(self) -> str:
        """What the node has logged since the test began."""
        return self.site.node.log()[self._log_start :]
