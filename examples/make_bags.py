"""Record the two walks that ``make_walks.py`` cuts as a robot and a telephone would: bags, a video, a trajectory.

    python examples/make_bags.py monday tuesday bags

It writes into the folder ``bags``:

* ``monday``, a rosbag2 (SQLite) with Monday's camera (``/camera/image_raw/compressed``, a frame a second) and odometry
  (``/odom``, five poses a second), and ``tuesday.mcap`` with those of Tuesday;
* ``monday.avi``, Monday's walk as a video of four frames a second;
* ``monday.tum``, where Monday's robot was, in the form of TUM;
* ``labels.csv``: which of Monday's places each frame of Tuesday's bag shows, by the ids that placerec gives to frames.

It needs the packages ``rosbags`` and ``opencv-python-headless``.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

SECOND = 1_000_000_000  # nanoseconds
BEGIN = {"monday": 1_767_607_200 * SECOND, "tuesday": 1_767_693_600 * SECOND}  # ten o'clock, 5 and 6 January 2026
CAMERA, ODOMETRY = "/camera/image_raw/compressed", "/odom"
TYPES = get_typestore(Stores.ROS2_HUMBLE)


def walk(folder: Path) -> list[tuple[str, Path, float]]:
    """Id, file and place in metres of each frame, in order."""
    with (folder / "places.csv").open(newline="") as file:
        return [(row["id"], folder / row["file"], float(row["x"])) for row in csv.DictReader(file)]


def header(time: int) -> Any:
    stamp = TYPES.types["builtin_interfaces/msg/Time"](sec=time // SECOND, nanosec=time % SECOND)
    return TYPES.types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")


def picture(time: int, path: Path) -> Any:
    data = np.frombuffer(path.read_bytes(), np.uint8)
    return TYPES.types["sensor_msgs/msg/CompressedImage"](header=header(time), format="jpeg", data=data)


def odometry(time: int, x: float) -> Any:
    """The robot at ``x``; it looks along the x axis."""
    types = TYPES.types
    zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=x, y=0.0, z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    return types["nav_msgs/msg/Odometry"](
        header=header(time),
        child_frame_id="base_link",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](
            twist=types["geometry_msgs/msg/Twist"](linear=zero, angular=zero), covariance=np.zeros(36)
        ),
    )


def messages(folder: Path) -> Iterator[tuple[int, str, Any]]:
    """Time, topic and message, as a recorder would receive them."""
    frames, begin = walk(folder), BEGIN[folder.name]
    places = [x for *_, x in frames]
    for tick in range(5 * (len(frames) - 1) + 1):
        time = begin + tick * SECOND // 5
        if tick % 5 == 0:
            yield time, CAMERA, picture(time, frames[tick // 5][1])
        yield time, ODOMETRY, odometry(time, float(np.interp(tick / 5, range(len(places)), places)))


def write_bag(folder: Path, path: Path, plugin: StoragePlugin) -> None:
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for time, topic, message in messages(folder):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(connections[topic], time, TYPES.serialize_cdr(message, kind))


def write_video(folder: Path, path: Path) -> None:
    pictures = [cv2.imread(str(file)) for _, file, _ in walk(folder)]
    first = pictures[0]
    assert first is not None
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 4.0, (first.shape[1], first.shape[0]))
    for pixels in pictures:
        assert pixels is not None
        writer.write(cv2.resize(pixels, (first.shape[1], first.shape[0])))  # the last of each place are narrower
    writer.release()


def frame_id(day: str, number: int) -> str:
    """The id that placerec gives to a frame of a bag: its topic and its stamp."""
    return f"camera-image_raw-compressed-{BEGIN[day] // SECOND + number}.000000000"


def write_labels(monday: Path, tuesday: Path, path: Path) -> None:
    numbers = {name: number for number, (name, *_) in enumerate(walk(monday))}
    with (tuesday / "labels.csv").open(newline="") as file:
        shown = {row["file"]: row["place"] for row in csv.DictReader(file)}
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["file", "place"])
        for number, (_, picture_file, _) in enumerate(walk(tuesday)):
            place = shown[picture_file.name]
            table.writerow([frame_id("tuesday", number), frame_id("monday", numbers[place]) if place else ""])


def make_bags(monday: Path, tuesday: Path, out: Path) -> None:
    """Write everything into the folder ``out``, which must not hold it already."""
    out.mkdir(parents=True, exist_ok=True)
    write_bag(monday, out / "monday", StoragePlugin.SQLITE3)
    write_bag(tuesday, out / "tuesday", StoragePlugin.MCAP)
    next((out / "tuesday").glob("*.mcap")).rename(out / "tuesday.mcap")
    for rest in (out / "tuesday").iterdir():
        rest.unlink()
    (out / "tuesday").rmdir()
    write_video(monday, out / "monday.avi")
    lines = [f"{BEGIN['monday'] // SECOND + number} {x:g} 0 0 0 0 0 1" for number, (*_, x) in enumerate(walk(monday))]
    (out / "monday.tum").write_text("# time x y z qx qy qz qw\n" + "\n".join(lines) + "\n")
    write_labels(monday, tuesday, out / "labels.csv")


def main() -> None:
    parser = argparse.ArgumentParser(description="Record the walks of make_walks.py in bags and a video.")
    parser.add_argument("monday", type=Path, nargs="?", default=Path("monday"))
    parser.add_argument("tuesday", type=Path, nargs="?", default=Path("tuesday"))
    parser.add_argument("out", type=Path, nargs="?", default=Path("bags"))
    arguments = parser.parse_args()
    make_bags(arguments.monday, arguments.tuesday, arguments.out)
    for path in sorted(arguments.out.iterdir()):
        print(path)


if __name__ == "__main__":
    main()
