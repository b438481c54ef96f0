"""A robot that streams its camera into a session over a WebSocket and drives by the belief.

    python examples/stream.py --map tour --frames pictures/camera

Each image of the folder stands for one camera frame.  The session is begun over HTTP; then every frame is a text
message with what the robot knows of it (its number, when it was taken, its odometry) and a binary one with the picture.
A key comes from PLACEREC_KEY.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

PICTURES = (".jpg", ".jpeg", ".png", ".webp")


def act(answer: dict[str, Any]) -> str:
    """What the robot makes of an answer; here it only says so."""
    if "problem" in answer:
        return f"frame refused: {answer['problem']['detail']}"
    if answer["lost"]:
        return "lost: stop, look around"
    match answer["verdict"]:
        case "recognized":
            alone = answer["single"]["verdict"]
            return f"at {answer['place']['id']} ({answer['probability']:.2f}); the frame alone: {alone}"
        case "ambiguous":
            candidates = ", ".join(
                f"{one['place']['id']} ({one['probability']:.2f})" for one in answer["candidates"][:3]
            )
            return f"at one of {candidates}: drive on"
        case _:
            return f"not in this map ({answer['unknown']:.2f})"


def stream(url: str, map_id: str, frames: Path) -> None:
    """One run: a session, its frames, its end."""
    sessions = f"{url}/v1/maps/{map_id}/sessions"
    key = os.environ.get("PLACEREC_KEY")  # not an option: others can see the words of a command
    headers = {"Authorization": f"Bearer {key}"} if key else {}
    begun = httpx.post(sessions, json={"filter": "bayes"}, headers=headers)
    begun.raise_for_status()
    session = f"{sessions}/{begun.json()['id']}"
    try:
        address = session.replace("http", "ws", 1) + "/stream"
        with connect(address, compression=None, additional_headers=headers) as connection:
            for number, path in enumerate(sorted(frames.iterdir())):
                if path.suffix.lower() not in PICTURES:
                    continue
                connection.send(json.dumps({"frame": number, "timestamp": datetime.now(UTC).isoformat()}))
                connection.send(path.read_bytes())
                print(f"{path.name}: {act(json.loads(connection.recv(timeout=30)))}", flush=True)
    finally:
        httpx.delete(session, headers=headers)


def main() -> None:
    parser = argparse.ArgumentParser(description="Stream camera frames into a session.")
    parser.add_argument("--url", default="http://127.0.0.1:8000")
    parser.add_argument("--map", required=True, help="id of the map")
    parser.add_argument("--frames", type=Path, required=True, help="folder of images that stands for the camera")
    options = parser.parse_args()
    try:
        stream(options.url.rstrip("/"), options.map, options.frames)
    except (httpx.HTTPError, ConnectionClosed, InvalidStatus, OSError) as error:
        sys.exit(f"The robot stops: {error}")


if __name__ == "__main__":
    main()
