"""The time that the ROS 2 node adds to an answer: from a published image to the published answer, beside HTTP.

    python -m benchmarks.clients.ros2               # on drawn frames
    python -m benchmarks.clients.ros2 --corridor    # the real corridor as a bag at 10 Hz

For the times, two sessions of one service get the same frames in turn, one over HTTP from this process, one by the
node, whose peer publishes each frame and hears the answer; the node's share is also given beside its own request,
which does not depend on what else the machine does meanwhile.  The corridor's verdicts and places are compared with
those over HTTP.  All of it runs in a network of its own and needs ``.venv-ros`` (``. scripts/environment; environment
ros``).
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

from benchmarks.report import report, verdict
from placerec_client import Client
from placerec_ros.parameters import PARAMETERS
from placerec_ros.run import moment_of
from tests.clients.ros2.network import own_network
from tests.clients.ros2.robot import Node, Peer
from tests.service.scenes import encoded, scene, seen_again
from tests.service.server import Server

LIMIT = 5.0
CORRIDOR = Path(__file__).parents[3] / "shared" / "datasets" / "eval" / "corridor"
BASE = 1_763_800_000.0
RATE = 10.0
WIDTH, HEIGHT = 640, 480


class Bench:
    """A service, a node in it and a peer, on the map ``bench``."""

    def __init__(self, folder: Path, references: list[bytes]) -> None:
        self.folder = folder
        self.server = Server(folder / "service")
        self.peer = Peer(folder / "peer")
        self.server.wait()
        self.server.create_map("bench")
        for number, data in enumerate(references):
            done = self.server.enrol("bench", f"p{number:04d}", data, x=number, y=0, heading=0, sequence="walk")
            assert done.status_code == 201, done.text
        self.url = f"http://127.0.0.1:{self.server.port}"
        # With best effort Fast DDS loses raw images that do not fit its shared memory, which are not to be measured.
        self.node = Node(folder / "node", {"qos_overrides./image.subscription.reliability": "reliable"})
        self.peer.do("listen", topic="answer")
        own = {"url": self.url, "map": "bench", "use_camera_info": False, "deadline": 30.0, "queue_length": 100}
        self._own = {**{one.name: one.default for one in PARAMETERS}, **own}

    def activate(self, image_type: str) -> None:
        """Configure and activate the node for a type of images."""
        self.peer.do("set", values={**self._own, "image_type": image_type})
        for name in ("configure", "activate"):
            assert self.peer.do("transition", name=name)["success"], self.node.log()
        self.peer.hears(1)
        self.peer.connected("/image")

    def deactivate(self) -> None:
        """Take the node back."""
        for name in ("deactivate", "cleanup"):
            self.peer.do("transition", name=name)
        self.peer.hears(0)

    def stop(self) -> None:
        """End all processes."""
        self.node.stop()
        self.peer.stop()
        self.server.stop()


def in_turn(
    bench: Bench, kind: str, frames: list[Path], sent: list[Any], fields: dict[str, Any]
) -> dict[str, list[float]]:
    """Milliseconds of each frame over HTTP and by the node, one after the other, each first in every other turn."""
    bench.peer.do("advertise", topic="/image", kind=kind, reliable=True)
    bench.activate("compressed" if kind == "CompressedImage" else "raw")
    times: dict[str, list[float]] = {"http": [], "node": [], "request": []}
    with Client(bench.url) as client, client.maps["bench"].sessions.begin() as session:

        def over_http(number: int, stamp: float) -> None:
            began = time.perf_counter()
            session.send(sent[number], frame=number, timestamp=moment_of(round(stamp * 1e9)))
            times["http"].append(1e3 * (time.perf_counter() - began))

        def by_node(number: int, stamp: float) -> None:
            done = bench.peer.do("ask", topic="/image", kind=kind, stamp=stamp, file=str(frames[number]), **fields)
            times["node"].append(1e3 * done["seconds"])
            times["request"].append(done["answer"]["request_milliseconds"])

        for number in range(len(frames)):
            stamp = BASE + number / RATE
            steps = (over_http, by_node) if number % 2 else (by_node, over_http)
            for step in steps:
                step(number, stamp)
    bench.deactivate()
    bench.peer.do("withdraw", topic="/image")
    return {name: found[5:] for name, found in times.items()}  # the first ones warm up


def latency(folder: Path, count: int) -> None:
    """Measure and print the table."""
    walls = [scene(900 + number, WIDTH + 240, HEIGHT) for number in range(-(-count // 10))]
    pixels = [np.ascontiguousarray(wall[:, 24 * step : 24 * step + WIDTH]) for wall in walls for step in range(10)]
    bench = Bench(folder, [encoded(one) for one in pixels])
    again = [seen_again(one, number) for number, one in enumerate(pixels)][:count]
    rows: list[tuple[object, ...]] = []
    figures: dict[str, Any] = {}
    try:
        for kind in ("CompressedImage", "Image"):
            files, sent = [], []
            for number, one in enumerate(again):
                compressed = kind == "CompressedImage"
                data = encoded(one) if compressed else cv2.cvtColor(one, cv2.COLOR_BGR2RGB).tobytes()
                files.append(folder / f"{kind}-{number}")
                files[-1].write_bytes(data)
                sent.append(data if compressed else encoded(one))
            fields = {} if kind == "CompressedImage" else {"width": WIDTH, "height": HEIGHT, "encoding": "rgb8"}
            times = in_turn(bench, kind, files, sent, fields)
            http, node, request = (np.array(times[name]) for name in ("http", "node", "request"))
            added, beside = float(np.median(node - request)), float(np.median(node - http))
            held = verdict(round(added, 2), LIMIT) if kind == "CompressedImage" else ""
            rows.append((kind, len(http), float(np.median(http)), float(np.median(node)), beside, added, held))
            figures[kind] = {
                "frames": len(http),
                "http": {f"p{p}": float(np.percentile(http, p)) for p in (50, 95)},
                "node": {f"p{p}": float(np.percentile(node, p)) for p in (50, 95)},
                "request": {f"p{p}": float(np.percentile(request, p)) for p in (50, 95)},
                "beside_http_median": beside,
                "added_median": added,
                "added_p95": float(np.percentile(node - request, 95)),
            }
    finally:
        bench.stop()
    title = f"From a published image of {WIDTH} x {HEIGHT} to the published answer, milliseconds (medians)"
    report(
        "ros2",
        title,
        ("type", "frames", "JPEG over HTTP", "by the node", "beside HTTP", "beside its own request", "limit"),
        rows,
        figures,
    )


def corridor(folder: Path) -> None:
    """Play the corridor's queries and compare the answers with those over HTTP."""
    references, queries = (sorted((CORRIDOR / name).glob("*.jpg")) for name in ("ref", "query"))
    bench = Bench(folder, [path.read_bytes() for path in references])
    try:
        messages = [
            {"topic": "/image", "kind": "CompressedImage", "stamp": BASE + number / RATE, "file": str(path)}
            for number, path in enumerate(queries)
        ]
        bench.peer.do("write_bag", path=str(folder / "bag"), messages=messages)
        bench.server.query("bench", queries[0].read_bytes(), verify="always")  # the first one is slow
        bench.peer.do("advertise", topic="/image", kind="CompressedImage", reliable=True)
        bench.activate("auto")
        bench.peer.do("play", path=str(folder / "bag"), wait=True)
        answers: list[dict[str, Any]] = []
        quiet = time.monotonic()
        while len(answers) < len(queries) and time.monotonic() < quiet + 10:
            if heard := bench.peer.take("answer"):
                answers, quiet = answers + heard, time.monotonic()
            time.sleep(0.2)
        with Client(bench.url) as client, client.maps["bench"].sessions.begin() as session:
            same = 0
            for one in answers:
                data = queries[round((one["stamp"] - BASE) * RATE)].read_bytes()
                expected = session.send(data, frame=one["number"], timestamp=moment_of(round(one["stamp"] * 1e9)))
                place = None if expected.place is None else expected.place.id
                same += (one["verdict"], one["place"]) == (expected.verdict, place)
        bench.deactivate()
    finally:
        bench.stop()
    figures = {
        "played": len(queries),
        "answered": len(answers),
        "same": same,
        "recognized": sum(one["verdict"] == "recognized" for one in answers),
    }
    title = "The corridor as a bag at 10 Hz: verdict and place beside those over HTTP"
    report("ros2-corridor", title, tuple(figures), [tuple(figures.values())], figures)


def main(
    frames: Annotated[int, typer.Option(min=20, help="Of each type.")] = 200,
    of_corridor: Annotated[bool, typer.Option("--corridor", help="Play the real corridor instead.")] = False,
) -> None:
    """Measure in a network of its own."""
    if of_corridor and not CORRIDOR.exists():
        sys.exit(f"There is no {CORRIDOR}.")
    with own_network(), tempfile.TemporaryDirectory() as text:
        if of_corridor:
            corridor(Path(text))
        else:
            latency(Path(text), frames)


if __name__ == "__main__":
    typer.run(main)
