"""A long drive: the node takes images for as long as one likes, and must not grow.

    python -m tests.clients.ros2.soak --minutes 60 [--rate 10]

It needs ``.venv-ros`` and a machine that allows network namespaces.  ``scripts/soak ros --minutes 60`` runs it.  The
walk is driven up and down; every few minutes the session is begun anew, the node is deactivated and activated, and
pictures are looked at, so that all that could leak is done many times.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.process import memory
from tests.clients.ros2.network import own_network
from tests.clients.ros2.robot import Robot, Site, walk, walked_again
from tests.service.server import Server

SETTLING = 0.25
"""The share of the drive in which memory may still grow."""
MOST_GROWTH = 8.0
"""MB of resident memory that the node may grow by after that, which is less than a hundred raw images of the walk."""


@dataclass(frozen=True)
class Drive:
    """What came of a drive: counts, and the node's memory in MB after each tenth of it."""

    published: int
    answered: int
    poses: int
    recognized: int
    memory: list[float]
    threads: int

    @property
    def growth(self) -> float:
        """MB by which the node has grown since it had settled."""
        start = max(1, round(SETTLING * len(self.memory)))
        return self.memory[-1] - max(self.memory[start - 1 : start + 1])


def drive(folder: Path, minutes: float, rate: float) -> Drive:
    """Drive in the present network."""
    frames = walk()
    site = Site(folder, Server(folder / "service", forked=False), {}, frames, walked_again(frames))
    for number, data in enumerate(site.again):
        (folder / f"again-{number:02d}.jpg").write_bytes(data)
    site.start_peers()
    try:
        site.server.wait()
        site.enrol("walk")
        return _driven(Robot(site), 60 * minutes, rate)
    finally:
        site.stop()


def _driven(robot: Robot, seconds: float, rate: float) -> Drive:
    robot.peer.do("advertise", topic="/image", kind="CompressedImage")
    robot.begin(role="", queue_length=2, deadline=10.0)
    robot.connected()
    count, pid = len(robot.site.again), robot.site.node.process.pid
    order = [*range(count), *range(count - 2, 0, -1)]
    answered = poses = recognized = published = 0
    used: list[float] = []
    began = time.monotonic()
    while (now := time.monotonic() - began) < seconds:
        robot.look(number=order[published % len(order)])
        published += 1
        if published % 100 == 0:
            heard = robot.peer.take("answer")
            answered, poses = answered + len(heard), poses + len(robot.peer.take("pose"))
            recognized += sum(one["verdict"] == "recognized" for one in heard)
            for topic in ("/diagnostics", "map_to_odom", "annotated/compressed"):
                robot.peer.take(topic)
        if published % 1500 == 0:
            _disturb(robot, published)
        if now >= seconds * (len(used) + 1) / 20:
            used.append(memory(pid))
            print(f"{now / 60:.1f} min: {published} published, {answered} answered, {used[-1]:.1f} MB", flush=True)
        time.sleep(max(0.0, began + published / rate - time.monotonic()))
    used.append(memory(pid))
    robot.answers_settled()
    threads = len(list(Path(f"/proc/{pid}/task").iterdir()))
    robot.end()
    return Drive(published, answered, poses, recognized, used, threads)


def _disturb(robot: Robot, published: int) -> None:
    """Do what is not done for every frame."""
    if published % 3000:
        assert robot.peer.do("call", service="relocalize")["success"]
        robot.peer.do("listen", topic="annotated/compressed")
    else:
        robot.peer.do("deafen", topic="annotated/compressed")
        assert robot.transition("deactivate")
        assert robot.transition("activate")
        robot.connected()


def main() -> None:
    """Drive, and say how much the node has grown."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=10.0, help="images a second")
    chosen = parser.parse_args()
    with own_network(), tempfile.TemporaryDirectory() as folder:
        done = drive(Path(folder), chosen.minutes, chosen.rate)
    print(
        f"{done.published} published, {done.answered} answered, {done.recognized} recognized, {done.poses} poses; "
        f"{done.memory[0]:.1f} to {done.memory[-1]:.1f} MB, {done.growth:+.1f} MB after it had settled; "
        f"{done.threads} threads"
    )
    if done.growth > MOST_GROWTH:
        raise SystemExit(f"The node grew by more than {MOST_GROWTH:g} MB.")


if __name__ == "__main__":
    main()
