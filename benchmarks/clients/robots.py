"""Robots in one asyncio process that send frames by the client and drive on when they have the answer.

    python benchmarks/clients/robots.py --url http://127.0.0.1:8000 --map lab --frames DIR --robots 16

They do what those of ``service.commands.load`` do, but every answer is read and checked against its model.  Prints one
JSON object.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import time
from pathlib import Path
from typing import Any, Literal

from placerec_client import AsyncClient
from service.commands.load import processor_seconds

Verify = Literal["auto", "always", "never"]


async def drive(url: str, map_id: str, frames: list[bytes], robots: int, seconds: float, verify: Verify) -> Any:
    """Let robots drive; each answer's time in milliseconds, and what they cost."""
    times: list[float] = []

    async def robot(index: int) -> None:
        while time.perf_counter() < until:
            began = time.perf_counter()
            answer = await client.maps[map_id].query(frames[index % len(frames)], verify=verify)
            assert answer.verdict
            times.append(time.perf_counter() - began)
            index += 1

    async with AsyncClient(url) as client:
        await client.maps[map_id].query(frames[0], verify=verify)  # the model is built by the first answer
        before, began = processor_seconds(), time.perf_counter()
        until = began + seconds
        await asyncio.gather(*(robot(7 * number) for number in range(robots)))
        spent = time.perf_counter() - began
    return {
        "robots": robots,
        "seconds": spent,
        "milliseconds": [round(1e3 * one, 3) for one in times],
        "processor_seconds": processor_seconds() - before,
    }


def main() -> None:
    """Parse the arguments, drive, and print the measurement as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--url", required=True)
    parser.add_argument("--map", required=True)
    parser.add_argument("--frames", type=Path, required=True, help="folder of JPEG files; .jpg")
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--verify", choices=("auto", "always", "never"), default="auto")
    given = parser.parse_args()
    frames = [path.read_bytes() for path in sorted(given.frames.glob("*.jpg"))]
    found = asyncio.run(drive(given.url, given.map, frames, given.robots, given.seconds, given.verify))
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
