"""A process that uses a data directory until it is killed, traced or refused; ``python -m`` it with an action.

Each acknowledged step is told by a line on standard output that begins with ``ack``.
"""

from __future__ import annotations

import itertools
import json
import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from core.errors import PlacerecError
from core.maps import MapSettings
from core.places import PlaceFields
from core.store import Directory, Map
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame

LARGE = 4096
"""Dimension with which the descriptors are by far the most that is written."""


def acknowledge(text: str) -> None:
    os.write(1, f"ack {text}\n".encode())


def everything(directory: Path) -> None:
    """Every kind of write once or more."""
    atlas = Directory(directory, rows_per_segment=4)
    acknowledge("opened")
    lab = atlas.create("lab", ENCODER, DIMENSION, MapSettings(keep="image"), local_shape=LOCAL_SHAPE)
    acknowledge("created map")
    lab.enrol([frame("p0", sequence="monday")])
    acknowledge("enrolled one")
    lab.enrol([frame(f"p{i}", sequence="monday", x=i) for i in range(1, 11)])  # fills two segments
    acknowledge("enrolled ten")
    lab.enrol([frame("p1", "another"), frame("p2", sequence="tuesday")])
    acknowledge("replaced and updated")
    lab.enrol([frame("begins-a-segment")])  # with no cache to be written at the same time
    acknowledge("enrolled into a new segment")
    lab.set_fields("p3", PlaceFields(metadata={"a": 1}))
    acknowledge("set fields")
    lab.patch("p4", {"sequence": "tuesday"})
    acknowledge("patched")
    lab.edit({"description": "the laboratory"})
    acknowledge("edited")
    lab.forget("p5")
    acknowledge("forgot")
    lab.forget_sequence("monday")
    acknowledge("forgot sequence")
    atlas.create("hall", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame("h")])
    acknowledge("created another")
    atlas.delete("hall")
    acknowledge("deleted")
    atlas.close()
    acknowledge("closed")
    atlas = Directory(directory, rows_per_segment=4)
    atlas.get("lab").enrol([frame("late")])
    acknowledge("enrolled after a restart")
    for i in range(300):  # as many pages as make SQLite move its log into the file
        atlas.get("lab").patch("late", {"metadata": {"text": f"{i} " * 2000}})
        acknowledge("patched again")
    atlas.close()


def fill(directory: Path) -> None:
    """Enrols until a limit on the size of files stops it; then shows that the map still works."""
    atlas = Directory(directory, rows_per_segment=1024)
    lab = atlas.create("lab", ENCODER, LARGE, MapSettings(keep="none"), local_shape=LOCAL_SHAPE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, resource.RLIM_INFINITY))
    refused = _until_refused(lab)
    size = (directory / "maps" / "lab" / "descriptors-000001.seg").stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    before = lab.count_places()
    lab.enrol([frame("after", dimension=LARGE)])
    report = lab.verify()
    answer = {"error": refused, "places": before, "size": size, "after": lab.count_places(), "ok": report.ok}
    print(json.dumps(answer), flush=True)
    atlas.close()


def _until_refused(lab: Map) -> str:
    for i in itertools.count():
        try:
            lab.enrol([frame(f"p{i}-{j}", dimension=LARGE) for j in range(7)])
        except PlacerecError as error:
            return type(error).__name__
    raise AssertionError


def hold(directory: Path) -> None:
    """Keeps the data directory until standard input ends."""
    atlas = Directory(directory)
    acknowledge("holding")
    sys.stdin.read()
    atlas.close()


def keep_trying(directory: Path) -> None:
    """Enrols ten places one by one, telling of each whether it was taken."""
    atlas = Directory(directory, rows_per_segment=4)
    try:
        lab = atlas.get("lab")
    except PlacerecError:
        lab = atlas.get("lab")  # what was refused once is not refused for ever
    before = lab.count_places()
    outcomes = []
    for i in range(10):
        try:
            lab.enrol([frame(f"try{i}")])
            outcomes.append([f"try{i}", "taken"])
        except PlacerecError as error:
            outcomes.append([f"try{i}", type(error).__name__])
    report = lab.verify()
    found = [place.id for place in lab.places(None, 1000)[0]]
    answer = {
        "outcomes": outcomes, "before": before, "searched": lab.count_places(), "found": found, "ok": report.ok,
        "problems": report.problems,
    }  # fmt: skip
    print(json.dumps(answer), flush=True)
    atlas.close()


def die_at_refusal(directory: Path) -> None:
    """Enrols until the disk refuses, and is killed right then."""
    atlas = Directory(directory, rows_per_segment=4)
    lab = atlas.get("lab")
    for i in range(10):
        try:
            lab.enrol([frame(f"try{i}")])
            acknowledge(f"try{i}")
        except PlacerecError:
            os.kill(os.getpid(), signal.SIGKILL)


def die_at_refused_change(directory: Path) -> None:
    """Changes that append nothing, until the disk refuses one, and is killed right then."""
    lab = Directory(directory, rows_per_segment=4).get("lab")
    changes: list[Callable[[], object]] = [
        lambda: lab.edit({"description": "edited"}),
        lambda: lab.forget_sequence("monday"),  # a whole segment
        lambda: lab.patch("p4", {"metadata": {"floor": 2}}),
        lambda: lab.forget("p5"),
    ]
    for number, change in enumerate(changes):
        try:
            change()
            acknowledge(str(number))
        except PlacerecError:
            os.kill(os.getpid(), signal.SIGKILL)


ACTIONS: dict[str, Callable[[Path], None]] = {
    "everything": everything,
    "fill": fill,
    "hold": hold,
    "keep-trying": keep_trying,
    "die-at-refusal": die_at_refusal,
    "die-at-refused-change": die_at_refused_change,
}

if __name__ == "__main__":
    ACTIONS[sys.argv[1]](Path(sys.argv[2]))
