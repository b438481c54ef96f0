"""A robot's queries while others hold as many half-sent requests open as the service allows.

    python -m benchmarks.slow_connections --addresses 3 --connections 600 --seconds 12

Each address of this machine opens its connections, sends half of a head over each, one byte more now and then, and
starts again after six seconds.  The robot sends a frame when it has the answer to the last, over a new connection each
time, as after a refusal.  Memory and descriptors are those of the service.
"""

from __future__ import annotations

import socket
import tempfile
import threading
import time
from pathlib import Path
from typing import Annotated, Any

import httpx
import typer

from benchmarks.frames import camera_frames
from benchmarks.process import median, service
from benchmarks.report import report

HALF = b"GET /v1/maps HTTP/1.1\r\nHost: localhost\r\nX-Slow: "
COLUMNS = ("", "answered", "refused", "failed", "median", "memory", "descriptors")
AGAIN_SECONDS, BETWEEN_BYTES = 6.0, 0.5


def hold_open(address: str, port: int, connections: int, over: threading.Event) -> None:
    """Hold half-sent requests open until it is over."""
    while not over.is_set():
        held = []
        for _ in range(connections):
            one = socket.socket()
            one.bind((address, 0))
            one.setblocking(False)
            one.connect_ex(("127.0.0.1", port))
            held.append(one)
        began, sent = time.monotonic(), HALF
        while time.monotonic() - began < AGAIN_SECONDS and not over.wait(BETWEEN_BYTES):
            for one in held:
                try:
                    one.send(sent)
                except OSError:
                    continue  # the service closes slow connections on purpose
            sent = b"x"
        for one in held:
            one.close()


def robot(url: str, frames: list[bytes], seconds: float) -> dict[str, Any]:
    """How one robot is served: answers, refusals, failures, and the median time of an answer in milliseconds."""
    times: list[float] = []
    refused, failed = 0, 0
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        began = time.perf_counter()
        try:
            frame = frames[len(times) % len(frames)]
            answer = httpx.post(f"{url}/v1/encode", content=frame, headers={"Content-Type": "image/jpeg"}, timeout=30)
        except httpx.TransportError:
            failed += 1
            continue
        refused += answer.status_code == 503
        if answer.status_code == 200:
            times.append(1e3 * (time.perf_counter() - began))
    return {"answered": len(times), "refused": refused, "failed": failed, "median": median(times) if times else None}


def main(
    addresses: Annotated[int, typer.Option(min=1, max=200, help="Addresses that open connections.")] = 3,
    connections: Annotated[int, typer.Option(min=1, help="Connections of each address.")] = 600,
    seconds: Annotated[float, typer.Option(help="How long they are held open.")] = 12.0,
) -> None:
    """Measure a robot before and while the connections are held open."""
    frames, content = camera_frames(16)
    with tempfile.TemporaryDirectory() as folder, service(Path(folder), log=Path(folder) / "log") as process:
        url = str(process.client.base_url).rstrip("/")
        port = process.client.base_url.port or 80
        robot(url, frames, 2)  # a warm-up
        found: dict[str, Any] = {"before": robot(url, frames, seconds)}
        found["before"] |= {"memory": process.memory(), "descriptors": process.open_files()}
        over = threading.Event()
        holders = [
            threading.Thread(target=hold_open, args=(f"127.0.0.{10 + number}", port, connections, over))
            for number in range(addresses)
        ]
        for holder in holders:
            holder.start()
        time.sleep(2)
        within = found["within"] = robot(url, frames, seconds)
        within |= {"memory": process.memory(), "descriptors": process.open_files()}
        over.set()
        for holder in holders:
            holder.join()
        time.sleep(1)
        found["after"] = {"memory": process.memory(), "descriptors": process.open_files()}
        metrics = process.client.get("/metrics").text.splitlines()
        found["ended"] = [line for line in metrics if line.startswith("placerec_connections_ended_total")]
    rows = [(name, *(found[name].get(column, "") for column in COLUMNS[1:])) for name in ("before", "within", "after")]
    title = f"One robot, {content}, and {addresses} x {connections} connections with half a request"
    report("slow_connections", title, [*COLUMNS[:4], "median ms", "memory MB", "descriptors"], rows, found)


if __name__ == "__main__":
    typer.run(main)
