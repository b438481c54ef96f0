"""Frames of bags against the same frames in a folder: reading them, enrolling them over HTTP, and memory.

    python -m benchmarks.recordings.reading

The recordings take turns, in each round each once.  ``placerec enrol`` is run as a user runs it, its start included.
Memory is the most that a process has had which opens a recording and loads every frame.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from benchmarks.enrolment import enrol
from benchmarks.frames import camera_frames
from benchmarks.process import ROOT, median, service
from benchmarks.report import report

SECOND = 1_000_000_000
BEGIN = 1_700_000_000 * SECOND
TOPIC, KIND = "/camera/compressed", "sensor_msgs/msg/CompressedImage"

READING = (
    "import re, sys, time\nfrom pathlib import Path\nfrom core.recordings import open_recording\n"
    "began = time.perf_counter()\n"
    "with open_recording(Path(sys.argv[1])) as recording:\n"
    "    opened = time.perf_counter()\n"
    "    size = sum(len(frame.load()) for frame in recording.frames)\n"
    "    count = len(recording.frames)\n"
    "done = time.perf_counter()\n"
    "peak = int(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1])\n"
    "print(1e3 * (opened - began) / count, 1e3 * (done - opened) / count, 1.024e-3 * peak)"
)
"""Opens a recording in a process of its own: milliseconds a frame to open it and to load it, most memory in MB."""


def _messages(data: Iterable[bytes], store: Any) -> Iterable[tuple[int, Any]]:
    """Time and message of each frame, ten a second."""
    types = store.types
    more = {"seq": 0} if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else {}
    for number, one in enumerate(data):
        taken = BEGIN + number * SECOND // 10
        stamp = types["builtin_interfaces/msg/Time"](sec=taken // SECOND, nanosec=taken % SECOND)
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **more)
        yield taken, types[KIND](header=header, format="jpeg", data=np.frombuffer(one, np.uint8))


def write_folder(path: Path, data: Iterable[bytes]) -> Path:
    """The frames as files."""
    path.mkdir()
    for number, one in enumerate(data):
        (path / f"{number:06d}.jpg").write_bytes(one)
    return path


def write_rosbag2(path: Path, data: Iterable[bytes], plugin: StoragePlugin, packed: bool = False) -> Path:
    """The frames as a rosbag2."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Ros2Writer(path, version=9, storage_plugin=plugin)
    if packed:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(TOPIC, KIND, typestore=store)
        for time_, message in _messages(data, store):
            writer.write(connection, time_, store.serialize_cdr(message, KIND))
    return path


def write_ros1(path: Path, data: Iterable[bytes]) -> Path:
    """The frames as a ROS 1 bag."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(path) as writer:
        connection = writer.add_connection(TOPIC, KIND, typestore=store)
        for time_, message in _messages(data, store):
            writer.write(connection, time_, store.serialize_ros1(message, KIND))
    return path


WRITERS: dict[str, Callable[[Path, Iterable[bytes]], Path]] = {
    "folder": lambda folder, data: write_folder(folder / "folder", data),
    "rosbag2, SQLite": lambda folder, data: write_rosbag2(folder / "sqlite", data, StoragePlugin.SQLITE3),
    "rosbag2, MCAP": lambda folder, data: write_rosbag2(folder / "mcap", data, StoragePlugin.MCAP),
    "rosbag2, MCAP, packed": lambda folder, data: write_rosbag2(folder / "packed", data, StoragePlugin.MCAP, True),
    "ROS 1": lambda folder, data: write_ros1(folder / "walk.bag", data),
}


def read(path: Path) -> tuple[float, float, float]:
    """Milliseconds a frame to open and to load a recording, and the most memory of the process in MB."""
    command = [sys.executable, "-c", READING, str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    opened, loaded, peak = map(float, done.stdout.split())
    return opened, loaded, peak


def main(
    frames: Annotated[int, typer.Option(min=16)] = 300,
    long: Annotated[int, typer.Option(min=16, help="Frames of the recordings whose memory is measured.")] = 6000,
    rounds: Annotated[int, typer.Option(min=1)] = 3,
) -> None:
    """Medians over the rounds, in which the recordings take turns."""
    data, content = camera_frames(frames, "reference")
    measured: dict[str, dict[str, list[float]]] = {name: {} for name in WRITERS}
    with tempfile.TemporaryDirectory() as folder:
        root, longer = Path(folder) / "short", Path(folder) / "long"
        root.mkdir()
        longer.mkdir()
        paths = {name: write(root, data) for name, write in WRITERS.items()}
        with service(Path(folder) / "service", log=Path(os.devnull)) as process:
            where = ["--url", str(process.client.base_url)]
            environment = dict(os.environ)
            for number in range(rounds):
                for name, path in paths.items():
                    opened, loaded, _ = read(path)
                    spent, _ = enrol(path, f"map-{number}-{list(paths).index(name)}", where, environment)
                    found = {"open": opened, "load": loaded, "enrol": 1e3 * spent / frames}
                    for what, value in found.items():
                        measured[name].setdefault(what, []).append(value)
                    time.sleep(0.5)
        for name, write in WRITERS.items():
            repeated = (data[number % frames] for number in range(long))
            measured[name]["peak"] = [read(paths[name])[2]]
            measured[name]["long peak"] = [read(write(longer, repeated))[2]]
    figures = {name: {what: median(values) for what, values in found.items()} for name, found in measured.items()}
    columns = ("open", "load", "enrol", "peak", "long peak")
    report(
        "recordings",
        f"Recordings of {frames} frames ({content}); milliseconds a frame, peaks in MB, the last of {long} frames",
        ("recording", *columns),
        [[name, *(figures[name][what] for what in columns)] for name in figures],
        {"frames": frames, "long": long, "rounds": rounds, "content": content, "recordings": figures},
    )


if __name__ == "__main__":
    typer.run(main)
