"""A robot that asks the service where it is, frame by frame.

    python examples/robot.py --map tour --frames pictures/camera

Each image of the folder stands for one camera frame; without ``--frames`` it draws some itself.  The client sends a
frame again until the deadline, under one request id, with pauses that grow, unless the answer would be the same.  A
frame that is refused or answered too late is no reason to stop.  A key comes from PLACEREC_KEY.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

from placerec_client import Client, DeadlineExceeded, Map, PlacerecError, Problem
from placerec_client.models import QueryAnswer

PICTURES = (".jpg", ".jpeg", ".png", ".webp")
OF_THE_FRAME = (400, 413, 415, 422)
"""Statuses of a frame that the service cannot use; the next one may be fine."""


def act(answer: QueryAnswer) -> str:
    """The robot's use of an answer; here it only says so."""
    candidates = ", ".join(f"{match.place.id} ({match.score:.3f})" for match in answer.matches[:3])
    if answer.place is not None:
        pose = answer.place.pose.model_dump(exclude_none=True) if answer.place.pose else "not known"
        return f"at {answer.place.id}, pose {pose}: correct the odometry"
    if answer.verdict == "ambiguous":
        return f"at one of {candidates}: drive on and look again"
    nearest = f"; most like it are {candidates}" if candidates else ""
    return f"not a place of this map ({answer.reason or 'nothing stands out'}){nearest}"


def look(lab: Map, frame: Path, deadline: float) -> str:
    """The robot's steps with one frame.

    Raises:
        PlacerecError: no frame will be answered: no such map, no permission, a service that needs its operator.
    """
    try:
        return act(lab.query(frame, deadline=deadline))
    except DeadlineExceeded:
        return "no answer in time: go on by odometry"
    except Problem as problem:
        if problem.status not in OF_THE_FRAME:
            raise
        return f"frame refused: {problem}"


def drive(url: str, map_id: str, folder: Path, deadline: float) -> None:
    """The robot's loop."""
    key = os.environ.get("PLACEREC_KEY")  # not an option: others can see the words of a command
    with Client(url, key=key) as client:  # one connection for the whole run
        for frame in sorted(folder.iterdir()):
            if frame.suffix.lower() in PICTURES:
                began = time.monotonic()
                told = look(client.maps[map_id], frame, deadline)
                print(f"{frame.name}: {told} [{1e3 * (time.monotonic() - began):.0f} ms]", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Ask the service where a robot is, frame by frame.")
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--map", required=True, help="id of the map")
    parser.add_argument("--frames", type=Path, help="folder of images that stands for the camera")
    parser.add_argument("--deadline", type=float, default=2.0, help="seconds after which an answer is of no use")
    options = parser.parse_args()
    try:
        if options.frames is not None:
            drive(options.url, options.map, options.frames, options.deadline)
            return
        from make_pictures import make_pictures

        with tempfile.TemporaryDirectory() as folder:
            make_pictures(Path(folder))
            drive(options.url, options.map, Path(folder) / "camera", options.deadline)
    except (PlacerecError, OSError) as error:
        sys.exit(f"The robot stops: {error}")


if __name__ == "__main__":
    main()
