"""Robots that send frames to a service and drive on when they have the answer: the load that ``placerec bench`` makes.

    python -m service.commands.load --url http://127.0.0.1:8000 --path /v1/maps/lab/query --frames DIR --robots 16

A process of its own, so that it shares no interpreter with the service, and of the standard library alone, so that
it costs little: a request is bytes made beforehand, and of an answer no more is read than its status and length.
Each robot has a connection of its own, which it keeps, and sends its next frame when it has the answer to the last.
Prints one JSON object.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import resource
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

RETRY_SECONDS = 0.05
KEY = "PLACEREC_KEY"


def request(host: str, path: str, data: bytes, key: str | None = None) -> bytes:
    """The bytes of a request that sends one frame."""
    head = f"POST {path} HTTP/1.1\r\nHost: {host}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n"
    if key:
        head += f"Authorization: Bearer {key}\r\n"
    return head.encode() + b"\r\n" + data


async def answer(reader: asyncio.StreamReader) -> int:
    """The status of the next answer, which is read to its end."""
    head = (await reader.readuntil(b"\r\n\r\n")).lower()
    _, _, length = head.partition(b"content-length:")
    await reader.readexactly(int(length.split(b"\r\n", 1)[0]))
    return int(head.split(b" ", 2)[1])


async def robot(
    host: str, port: int, requests: list[bytes], first: int, until: float, times: list[float], statuses: Counter[int]
) -> None:
    """Send frames until the time is up, and note how long each answer took, in seconds.

    A frame that is refused because the service is full is sent again, and its time goes on.
    """
    reader, writer = await asyncio.open_connection(host, port)
    index = first
    while time.perf_counter() < until:
        began = time.perf_counter()
        status = 503
        while status == 503:
            writer.write(requests[index % len(requests)])
            status = await answer(reader)
            statuses[status] += 1
            if status == 503:
                await asyncio.sleep(RETRY_SECONDS)
        times.append(time.perf_counter() - began)
        index += 1
    writer.close()


def measure(url: str, path: str, frames: Path, robots: int, seconds: float, key: str | None = None) -> dict[str, Any]:
    """The measurement of :func:`drive` in a process of its own.

    Args:
        key: of the service; without one, that of the environment.

    Raises:
        subprocess.CalledProcessError: the service cannot be reached, or hung up.
    """
    arguments = [
        "--url",
        url,
        "--path",
        path,
        "--frames",
        str(frames),
        "--robots",
        str(robots),
        "--seconds",
        str(seconds),
    ]
    command = [sys.executable, "-m", "service.commands.load", *arguments]
    environment = {**os.environ, **({} if key is None else {KEY: key})}  # not an argument, which others can see
    done = subprocess.run(command, capture_output=True, check=True, env=environment)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


async def drive(url: str, path: str, frames: list[bytes], robots: int, seconds: float) -> dict[str, object]:
    """Let robots drive; the numbers of statuses, and each answer's time in milliseconds."""
    parts = urlsplit(url)
    host, port = str(parts.hostname), parts.port or 80
    key = os.environ.get(KEY)
    requests = [request(parts.netloc, parts.path.rstrip("/") + path, data, key) for data in frames]
    times: list[float] = []
    statuses: Counter[int] = Counter()
    before = processor_seconds()
    began = time.perf_counter()
    until = began + seconds
    drives = [robot(host, port, requests, 7 * number, until, times, statuses) for number in range(robots)]
    await asyncio.gather(*drives)
    spent = time.perf_counter() - began
    return {
        "robots": robots,
        "seconds": spent,
        "statuses": {str(status): count for status, count in statuses.items()},
        "milliseconds": [round(1e3 * one, 3) for one in times],
        "processor_seconds": processor_seconds() - before,
    }


def processor_seconds() -> float:
    """The cost of this process so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    """Parse the arguments, drive, and print the measurement as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--url", required=True)
    parser.add_argument("--path", required=True, help="where frames are posted to, such as /v1/maps/lab/query")
    parser.add_argument("--frames", type=Path, required=True, help="folder of JPEG files; .jpg")
    parser.add_argument("--robots", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=5.0)
    given = parser.parse_args()
    frames = [path.read_bytes() for path in sorted(given.frames.glob("*.jpg"))]
    found = asyncio.run(drive(given.url, given.path, frames, given.robots, given.seconds))
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
