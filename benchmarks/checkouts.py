"""Two checkouts of this repository side by side: encoding, queries by 1, 4 and 16 robots, enrolment, start, memory.

    python -m benchmarks.checkouts ../other-checkout

Both services run at the same time on data of their own, and take turns at the load, so that whatever disturbs one
disturbs the other as well; medians over the turns are compared.  Both use the Python environment that runs this.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import IO, Annotated, Any

import httpx
import numpy as np
import typer

from benchmarks.frames import camera_frames
from benchmarks.process import peak_memory
from benchmarks.report import report

ROOT = Path(__file__).parents[1]
START_SECONDS = 120.0
BATCH = 64

ENCODE = """
import sys, time
try:
    from core.method.catalogue import DEFAULT_ENCODER, EncoderCatalogue
    from core.frames.images import decode
except ImportError:
    from core.encoders import DEFAULT_ENCODER, EncoderCatalogue
    from core.images import decode
encoder = EncoderCatalogue().get(DEFAULT_ENCODER)
data = open(sys.argv[1], "rb").read()
for _ in range(20):
    encoder.encode(decode(data))
print("ready", flush=True)
for line in sys.stdin:
    times = []
    for _ in range(int(line)):
        began = time.perf_counter()
        encoder.encode(decode(data))
        times.append(1e3 * (time.perf_counter() - began))
    print(sorted(times)[len(times) // 2], flush=True)
"""
"""Decodes and encodes one frame as often as a line says, and prints the median in milliseconds."""


def main(
    other: Annotated[Path, typer.Argument(help="The checkout to compare this one with.")],
    rounds: Annotated[int, typer.Option(help="Turns of each checkout.")] = 5,
    places: Annotated[int, typer.Option(help="Places of the map that is queried.")] = 1622,
    seconds: Annotated[float, typer.Option(help="Seconds of load in each turn.")] = 4.0,
) -> None:
    """Compare this checkout with another one."""
    checkouts = {"other": other.resolve(), "this": ROOT}
    found: dict[str, dict[str, list[float]]] = {name: defaultdict(list) for name in checkouts}
    frames, described = camera_frames(48)
    with tempfile.TemporaryDirectory() as temporary, ExitStack() as stack:
        folder = Path(temporary)
        (folder / "frames").mkdir()
        for index, frame in enumerate(frames):
            (folder / "frames" / f"{index:03d}.jpg").write_bytes(frame)
        for _ in range(3):  # the first start compiles what is not compiled yet, and is not counted below
            for name, checkout in checkouts.items():
                with running(checkout, folder / f"start-{name}") as (_, _, ready):
                    found[name]["start s"].append(ready)
        found = {name: defaultdict(list, {"start s": values["start s"][1:]}) for name, values in found.items()}
        encoders = {
            name: stack.enter_context(encoding(checkout, folder / "frames" / "000.jpg"))
            for name, checkout in checkouts.items()
        }
        services = {
            name: stack.enter_context(running(checkout, folder / name))[:2] for name, checkout in checkouts.items()
        }
        for client, _ in services.values():
            client.post("/v1/maps", json={"id": "lab", "keep": "none"}).raise_for_status()
            for first in range(0, places, BATCH):
                enrol(client, "lab", frames, first, min(BATCH, places - first))
        for turn in range(rounds):
            for name in list(checkouts)[:: 1 if turn % 2 else -1]:
                values, (client, _) = found[name], services[name]
                values["encode ms"].append(encoding_milliseconds(encoders[name], 60))
                for robots in (1, 4, 16):
                    seen = load(str(client.base_url), folder / "frames", robots, seconds)
                    values[f"{robots} robots, answers/s"].append(len(seen["milliseconds"]) / seen["seconds"])
                    values[f"{robots} robots, p50 ms"].append(float(np.median(seen["milliseconds"])))
                map_id = f"turn-{turn}"
                client.post("/v1/maps", json={"id": map_id, "keep": "none"}).raise_for_status()
                began = time.perf_counter()
                for first in range(0, 4 * BATCH, BATCH):
                    enrol(client, map_id, frames, first, BATCH)
                values["enrolment, places/s"].append(4 * BATCH / (time.perf_counter() - began))
        for name, (_, pid) in services.items():
            found[name]["peak memory MB"].append(peak_memory(pid))
    rows: list[list[object]] = []
    for measure in found["this"]:
        here, there = (float(np.median(found[name][measure])) for name in ("this", "other"))
        rows.append([measure, there, here, here / there])
    title = f"This checkout against {other} ({described}, {places} places, medians of {rounds} turns)"
    report("checkouts", title, ["", "other", "this", "this / other"], rows, {"found": found})


@contextmanager
def running(
    checkout: Path, data_dir: Path, settings: Mapping[str, str] = MappingProxyType({})
) -> Iterator[tuple[httpx.Client, int, float]]:
    """A service of a checkout: a client of it, its process, and the seconds until it was ready.

    Args:
        settings: more variables of its environment.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {**os.environ, "PYTHONPATH": str(checkout), "PLACEREC_DATA_DIR": str(data_dir)}
    words = [sys.executable, "-m", "service.commands", "serve", "--port", str(port)]
    environment |= {"PLACEREC_LOG_LEVEL": "warning", **settings}
    began = time.monotonic()
    process = subprocess.Popen(words, cwd=checkout, env=environment, stderr=subprocess.DEVNULL)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=120) as client:
            while time.monotonic() - began < START_SECONDS and process.poll() is None:
                try:
                    if client.get("/readyz").status_code == 200:
                        break
                except httpx.TransportError:
                    pass
                time.sleep(0.01)
            yield client, process.pid, time.monotonic() - began
    finally:
        process.terminate()
        process.wait(60)


@contextmanager
def encoding(checkout: Path, frame: Path) -> Iterator[subprocess.Popen[str]]:
    """A process of a checkout that encodes a frame on request."""
    words = [sys.executable, "-c", ENCODE, str(frame)]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    pipe = subprocess.PIPE
    with subprocess.Popen(words, cwd=checkout, env=environment, stdin=pipe, stdout=pipe, text=True) as process:
        _stream(process.stdout).readline()
        yield process
        _stream(process.stdin).close()


def encoding_milliseconds(process: subprocess.Popen[str], times: int) -> float:
    """Milliseconds of one encoding, the median of ``times``."""
    stdin = _stream(process.stdin)
    stdin.write(f"{times}\n")
    stdin.flush()
    return float(_stream(process.stdout).readline())


def _stream(stream: IO[str] | None) -> IO[str]:
    assert stream is not None
    return stream


def enrol(client: httpx.Client, map_id: str, frames: list[bytes], first: int, count: int) -> None:
    """Enrol frames by one request; a comment in each makes it differ from all others, so each is encoded."""
    places = [{"id": f"p{first + index:05d}", "file": f"f{index}", "sequence": "s"} for index in range(count)]
    files: list[Any] = [("places", (None, json.dumps(places), "application/json"))]
    for index in range(count):
        data = frames[(first + index) % len(frames)]
        note = uuid.uuid4().bytes
        marked = data[:2] + b"\xff\xfe" + (len(note) + 2).to_bytes(2, "big") + note + data[2:]
        files.append((f"f{index}", (f"{index}.jpg", marked, "image/jpeg")))
    items = client.post(f"/v1/maps/{map_id}/places", files=files).raise_for_status().json()["items"]
    assert all(item["status"] == 201 for item in items), items


def load(url: str, frames: Path, robots: int, seconds: float) -> dict[str, Any]:
    """The measurements of robots that query the map for some seconds, in a process of their own."""
    words = ["--url", url, "--path", "/v1/maps/lab/query", "--frames", str(frames)]
    words += ["--robots", str(robots), "--seconds", str(seconds)]
    command = [sys.executable, "-m", "service.commands.load", *words]
    done = subprocess.run(command, capture_output=True, check=True, cwd=ROOT)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


if __name__ == "__main__":
    typer.run(main)
