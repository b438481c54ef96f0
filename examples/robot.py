"""A robot that asks the service where it is, frame by frame.

    python examples/robot.py --map tour --frames pictures/camera

Each image of the folder stands for one camera frame; without ``--frames`` it draws some itself.
What to copy into a robot is ``localize``: a deadline, the same request id however often the frame
is sent, pauses that grow, and no retry where the answer would be the same.  A key comes from PLACEREC_KEY.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx

MEDIA_TYPES = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png", ".webp": "image/webp"}
BUSY = (429, 502, 503, 504)


class FrameRefused(Exception):
    """The service cannot use this frame; the next one may be fine."""


class QueriesRefused(Exception):
    """No frame will be answered: no such map, no permission, a service that needs its operator."""


def localize(
    client: httpx.Client, map_id: str, frame: bytes, media_type: str, deadline: float
) -> dict[str, Any] | None:
    """Ask where a frame was taken.

    Args:
        deadline: seconds; an older answer would be of no use, since the robot moves on.

    Returns:
        The service's answer, or None if none came in time.

    Raises:
        FrameRefused, QueriesRefused: sending the frame again would not help.
    """
    until = time.monotonic() + deadline
    request_id = uuid.uuid4().hex  # one id for all attempts: the service's log shows them as one request
    pause = 0.1
    while (left := until - time.monotonic()) > 0:
        wait = pause * random.uniform(0.5, 1.5)  # or a fleet would come back all at once
        try:
            response = client.post(
                f"/v1/maps/{map_id}/query",
                content=frame,
                headers={
                    "Content-Type": media_type,
                    "X-Request-Id": request_id,
                    "X-Request-Timeout": f"{left:.3f}",  # the service drops it unanswered after that
                },
                timeout=left,
            )
        except httpx.TransportError:  # no connection, or no answer in time
            pass
        else:
            if response.is_success:
                answer: dict[str, Any] = response.json()
                return answer
            if response.status_code in (400, 413, 415, 422):
                raise FrameRefused(explanation(response))
            if response.status_code not in BUSY:
                raise QueriesRefused(explanation(response))
            wait = max(wait, float(response.headers.get("Retry-After", 0)))
        time.sleep(max(0.0, min(wait, until - time.monotonic())))
        pause = min(2 * pause, 2.0)
    return None


def explanation(response: httpx.Response) -> str:
    """What the service says is wrong."""
    if response.headers.get("Content-Type", "").startswith("application/problem+json"):
        return str(response.json()["detail"])
    return f"{response.url} answered {response.status_code}"


def act(answer: dict[str, Any] | None) -> str:
    """What the robot makes of an answer; here it only says so."""
    if answer is None:
        return "no answer in time: go on by odometry"
    candidates = ", ".join(f"{match['place']['id']} ({match['score']:.3f})" for match in answer["matches"][:3])
    match answer["verdict"]:
        case "recognized":
            place = answer["place"]
            return f"at {place['id']}, pose {place['pose'] or 'not known'}: correct the odometry"
        case "ambiguous":
            return f"at one of {candidates}: drive on and look again"
        case _:
            nearest = f"; most like it are {candidates}" if candidates else ""
            return f"not a place of this map ({answer['reason'] or 'nothing stands out'}){nearest}"


def camera(folder: Path) -> Iterator[tuple[str, bytes, str]]:
    """Name, bytes and media type of each frame."""
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in MEDIA_TYPES:
            yield path.name, path.read_bytes(), MEDIA_TYPES[path.suffix.lower()]


def drive(url: str, map_id: str, folder: Path, deadline: float) -> None:
    """The robot's loop."""
    key = os.environ.get("PLACEREC_KEY")  # not an option: others can see the words of a command
    headers = {"Authorization": f"Bearer {key}"} if key else {}
    with httpx.Client(base_url=url, headers=headers) as client:  # one connection for the whole run
        for name, frame, media_type in camera(folder):
            began = time.monotonic()
            try:
                told = act(localize(client, map_id, frame, media_type, deadline))
            except FrameRefused as refused:
                told = f"frame refused: {refused}"
            print(f"{name}: {told} [{1e3 * (time.monotonic() - began):.0f} ms]", flush=True)


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
    except (QueriesRefused, OSError) as error:
        sys.exit(f"The robot stops: {error}")


if __name__ == "__main__":
    main()
