"""A robot for tests: the node and a peer, each a process of .venv-ros, and pictures of a walk."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from core.frames.preprocessing import Pixels
from tests.service.scenes import encoded, scene, seen_again
from tests.service.server import ROOT, Server

VENV = ROOT / ".venv-ros"
PYTHON = VENV / "bin" / "python"
PEER = Path(__file__).with_name("peer.py")
PATIENCE = 30.0

STEPS, SHIFT, WIDTH = 6, 24, 320
"""Frames cut out of one picture, pixels from one to the next, and pixels of a frame."""


def walk(first: int = 700, pictures: int = 3) -> list[Pixels]:
    """The frames of a walk along drawn walls: the camera moves sideways past each."""
    walls = [scene(first + number, WIDTH + SHIFT * STEPS, 240) for number in range(pictures)]
    return [np.ascontiguousarray(wall[:, SHIFT * step : SHIFT * step + WIDTH]) for wall in walls for step in range(STEPS)]


def walked_again(frames: list[Pixels]) -> list[bytes]:
    """The same walk in another light, as JPEG files."""
    return [encoded(seen_again(frame, number)) for number, frame in enumerate(frames)]


def enrol_walk(server: Server, map_id: str, frames: list[Pixels], **camera: str) -> None:
    """Make a map of a walk: a metre from frame to frame along +x."""
    server.create_map(map_id, same_place_radius=1.5)
    for number, frame in enumerate(frames):
        data = encoded(frame)
        done = server.enrol(map_id, f"p{number:02d}", data, x=number, y=0, heading=0, sequence="walk", **camera)
        assert done.status_code == 201, done.text


def ros_environment(**more: str) -> dict[str, str]:
    """The environment of processes of .venv-ros: ROS keeps to this machine, and logs as it goes."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PLACEREC_", "ROS_", "RMW_"))}
    own = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "RCUTILS_LOGGING_BUFFERED_STREAM": "0", "PYTHONUNBUFFERED": "1"}
    return {**kept, **own, **more}


class Node:
    """The node's process.

    Args:
        folder: for its log.
        parameters: its parameters.
        environment: variables, such as PLACEREC_KEY.
    """

    def __init__(self, folder: Path, parameters: Mapping[str, object], **environment: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.log_file = folder / "node.log"
        words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={_yaml(value)}")]
        command = [str(PYTHON), "-m", "placerec_ros.node", "--ros-args", *words]
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
            return self.process.wait(10)
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


def raw_rgb(pixels: Pixels) -> bytes:
    """The bytes of an Image in rgb8."""
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB).tobytes()
