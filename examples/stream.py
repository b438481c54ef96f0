"""A robot that streams its camera into a session over a WebSocket and drives by the belief.

    python examples/stream.py --map tour --frames pictures/camera

Each image of the folder stands for one camera frame.  The client numbers the frames, so that one that is sent again
after a lost connection counts once.  A key comes from PLACEREC_KEY.
"""

from __future__ import annotations

import argparse
import os
import sys
from datetime import UTC, datetime
from pathlib import Path

from placerec_client import Client, PlacerecError, Problem, problems
from placerec_client.models import SessionAnswer

PICTURES = (".jpg", ".jpeg", ".png", ".webp")
OVER = (problems.UnknownSession, problems.SessionExpired, problems.UnknownMap)


def act(answer: SessionAnswer) -> str:
    """The robot's use of an answer; here it only says so."""
    if answer.lost:
        return "lost: stop, look around"
    if answer.place is not None:
        return f"at {answer.place.id} ({answer.probability:.2f}); the frame alone: {answer.single.verdict}"
    if answer.verdict == "ambiguous":
        candidates = ", ".join(f"{one.place.id} ({one.probability:.2f})" for one in answer.candidates[:3])
        return f"at one of {candidates}: drive on"
    return f"not in this map ({answer.unknown:.2f})"


def run(url: str, map_id: str, frames: Path) -> None:
    """One run: a session, its frames, its end."""
    key = os.environ.get("PLACEREC_KEY")  # not an option: others can see the words of a command
    pictures = [path for path in sorted(frames.iterdir()) if path.suffix.lower() in PICTURES]
    with (
        Client(url, key=key) as client,
        client.maps[map_id].sessions.begin() as session,
        session.stream() as stream,
    ):
        for path in pictures:
            try:
                told = act(stream.send(path, timestamp=datetime.now(UTC)))
            except OVER:
                raise
            except Problem as problem:
                told = f"frame refused: {problem}"
            print(f"{path.name}: {told}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Stream camera frames into a session.")
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--map", required=True, help="id of the map")
    parser.add_argument("--frames", type=Path, required=True, help="folder of images that stands for the camera")
    options = parser.parse_args()
    try:
        run(options.url, options.map, options.frames)
    except (PlacerecError, OSError) as error:
        sys.exit(f"The robot stops: {error}")


if __name__ == "__main__":
    main()
