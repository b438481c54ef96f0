"""A robot in a simulator: it records a bag for the map, and drives by the map afterwards.

    python -m examples.simulator survey bags/hall
    python -m examples.simulator drive --map hall --url http://127.0.0.1:8000 --figure drive.svg

``drive`` starts the node of placerec_ros and drives the robot, whose odometry drifts by five percent, to a goal.  On
the way somebody carries the robot off to the other side of the hall.  It needs rclpy, of ROS or of ``.venv-ros``, and a
map whose camera ``front`` has the intrinsics of the robot's: see ``docs/tutorials/from-bag-to-robot.md``.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    from examples.simulator.world import LENGTH, WIDTH, Hall, Robot
    from placerec_ros.planar import Planar
except ModuleNotFoundError as missing:
    sys.exit(
        f"Error: {(missing.name or '').partition('.')[0]} is not installed here. Make the environment of ROS, "
        "(. scripts/environment; environment ros), and use its python: .venv-ros/bin/python -m examples.simulator."
    )

START = Planar(0.0, 10.0, -math.pi / 2)
WAYPOINTS = [(0.0, 10.0), (0.0, 0.0), (LENGTH, 0.0), (LENGTH, WIDTH), (0.0, WIDTH), (0.0, 13.0)]
"""From the start to the goal."""
CARRIED = 26.0
"""Seconds after which the robot is carried off."""
SET_DOWN = Planar(26.0, WIDTH - 0.3, math.pi - 0.05)
LIGHT, NOISE = 0.85, 5.0
"""The hall is darker than when the map was made, and the camera noisier."""
MOST_SECONDS = 120.0


@contextmanager
def node(url: str, map_id: str, log: Path) -> Iterator[None]:
    """The node placerec_ros, configured and active, as a process of its own."""
    parameters = {
        "url": url,
        "map": map_id,
        "camera": "front",
        "image_type": "raw",
        "autostart": True,
        "transform_rate": 100.0,
        "deadline": 60.0,  # time does not go on meanwhile
        # Each message counts, for time waits for it.
        "qos_overrides./camera/image_raw.subscription.reliability": "reliable",
        "qos_overrides./odom.subscription.reliability": "reliable",
    }
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={json.dumps(value)}")]
    words += ["-r", "image:=/camera/image_raw", "-r", "camera_info:=/camera/camera_info"]
    command = [sys.executable, "-m", "placerec_ros.node", "--ros-args", *words]
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, env=os.environ)
        try:
            yield
        finally:
            process.terminate()
            process.wait()


def drive(url: str, map_id: str, log: Path, seed: int, figure: Path | None, json_file: Path | None) -> bool:
    """Drive, and write what was asked for; whether the robot has arrived."""
    import rclpy

    from examples.simulator.camera import Camera
    from examples.simulator.driver import Driver
    from examples.simulator.figure import svg
    from examples.simulator.ros import DriverNode, RobotNode, Simulation

    hall = Hall()
    robot = Robot(hall, START, Planar(0.0, 0.0, 0.0), seed=seed)
    rclpy.init(args=[])
    try:
        with node(url, map_id, log):
            nodes = RobotNode(robot, Camera(hall, LIGHT, NOISE, seed)), DriverNode(Driver(WAYPOINTS))
            simulation = Simulation(*nodes, (CARRIED, SET_DOWN))
            simulation.begin()
            run = simulation.drive(MOST_SECONDS)
    finally:
        rclpy.try_shutdown()
    if figure is not None:
        figure.write_text(svg(run, hall))
    if json_file is not None:
        run.write(json_file)
    print(*run.summary(), sep="\n")
    return run.arrived


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m examples.simulator", description="A robot in a simulator.")
    commands = parser.add_subparsers(dest="command", required=True)
    survey = commands.add_parser("survey", help="Record the bag from which the map is made.")
    survey.add_argument("bag", type=Path)
    drives = commands.add_parser("drive", help="Drive by the map.")
    drives.add_argument("--map", required=True)
    drives.add_argument("--url", default="http://127.0.0.1:8000")
    drives.add_argument("--seed", type=int, default=1, help="Of the errors of odometry, and of the camera's noise.")
    drives.add_argument("--figure", type=Path, help="An SVG of the run.")
    drives.add_argument("--json", type=Path, help="All that happened.")
    drives.add_argument("--log", type=Path, default=Path("placerec_node.log"), help="Of the node.")
    chosen = parser.parse_args()
    try:
        if chosen.command == "survey":
            from examples.simulator.survey import record

            print(f"{record(chosen.bag)} frames in {chosen.bag}")
            return 0
        arrived = drive(chosen.url, chosen.map, chosen.log, chosen.seed, chosen.figure, chosen.json)
    except (ImportError, OSError) as error:  # TimeoutError is one: nobody answers
        log = f" {chosen.log} may say why." if isinstance(error, TimeoutError) else ""
        print(f"Error: {error}{log}", file=sys.stderr)
        return 1
    return 0 if arrived else 1


if __name__ == "__main__":
    sys.exit(main())
