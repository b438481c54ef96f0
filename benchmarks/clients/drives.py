"""Drives of a robot along corridor and lip6_outdoor: made-up poses, odometry that drifts, and a service's real answers.

The references stand a metre apart on a curve.  lip6_outdoor goes around: its references from 460 on pass the first ones
again, so its curve is closed, and they stand where they belong by their own keypoints (lab/training/ground_truth.py).
The robot drives along the curve by the true references of its frames, which are found by keypoints too, for the stated
ones are up to nine references off.  Odometry sees each step and turn with an error of ``DRIFT`` that lasts, another one
that does not, and a heading that wanders.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from core.frames.images import decode
from core.frames.traverses import read_ground_truth
from lab.training.ground_truth import corrected_truth, passes
from placerec_client import Client, Odometry
from placerec_ros.planar import Planar, wrapped
from placerec_ros.pose import PoseEstimate, estimate
from tests.service.server import Server

Array = NDArray[np.float64]

FOLDERS = {"corridor": ("ref", "query"), "lip6_outdoor": ("reference", "query")}
CIRCUIT = {"lip6_outdoor": 460}
"""References after which a traverse passes its first ones again."""
DRIFT = 0.05
"""The lasting error of odometry's steps and turns, up or down, and the standard deviation of another, as shares."""
WANDERING = math.radians(0.3)
"""Radians by which odometry's heading wanders along a metre."""
SMOOTHING = 3.0
"""Frames: truth has whole references, and a robot drives smoothly."""
START = datetime(2025, 11, 22, 8, tzinfo=UTC)
FLAT = (0, 1, 5, 7, 11, 35)
"""Where a covariance of 6 x 6 has xx, xy, x yaw, yy, y yaw, yaw yaw."""
COLUMNS = (
    *("true_x", "true_y", "true_yaw", "odom_x", "odom_y", "odom_yaw", "verdict", "source"),
    *("x", "y", "yaw", "xx", "xy", "xt", "yy", "yt", "tt"),
)


@dataclass(frozen=True)
class DriveFrame:
    """One frame of a drive: the robot's true pose, odometry's, and the pose of the service's answer, if it has one."""

    true: Planar
    odom: Planar
    verdict: str
    found: PoseEstimate | None


def curve(metres: Array, length: float) -> list[Planar]:
    """Poses at arc lengths along a closed curve of so many metres, with bends to both sides."""
    angle = np.linspace(0, 2 * np.pi, 20_000)
    radius = 1 + 0.3 * np.cos(3 * angle)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    scale = length / way[-1]
    at = np.interp(np.mod(metres, length), way * scale, angle)
    ahead = np.interp(np.mod(metres + 0.01, length), way * scale, angle)
    reach, further = scale * (1 + 0.3 * np.cos(3 * at)), scale * (1 + 0.3 * np.cos(3 * ahead))
    from_x, from_y, to_x, to_y = (
        reach * np.cos(at),
        reach * np.sin(at),
        further * np.cos(ahead),
        further * np.sin(ahead),
    )
    headings = np.arctan2(to_y - from_y, to_x - from_x)
    return [Planar(*map(float, one)) for one in zip(from_x, from_y, headings, strict=True)]


def odometry(true: Sequence[Planar], seed: int) -> list[Planar]:
    """The poses that drifting odometry makes of a drive, from a start of its own."""
    random = np.random.default_rng(seed)
    longer, more = 1 + DRIFT * random.choice((-1, 1), size=2)
    poses = [Planar(0.0, 0.0, float(random.uniform(-3, 3)))]
    for before, after in pairwise(true):
        step = before.inverse().then(after)
        length, noise = math.hypot(step.x, step.y), random.normal(size=3)
        factor = longer + DRIFT * noise[0]
        turn = step.yaw * (more + DRIFT * noise[1]) + WANDERING * math.sqrt(length) * noise[2]
        poses.append(poses[-1].then(Planar(factor * step.x, factor * step.y, wrapped(float(turn)))))
    return poses


class Traverse:
    """The references and queries of a data set, and where on the curve they are."""

    def __init__(self, name: str, data: Path) -> None:
        first, second = FOLDERS[name]
        self.references = sorted((data / name / first).glob("*.jpg"))
        self.queries = sorted((data / name / second).glob("*.jpg"))
        places, driven = self._metres(name, data)
        self.length = float(CIRCUIT.get(name, 2 * len(self.references)))
        self.places = curve(places, self.length)
        self.true = curve(driven, self.length)

    def _metres(self, name: str, data: Path) -> tuple[Array, Array]:
        """Metres along the curve of each reference and of each query."""
        stated = read_ground_truth(data / name / "ground_truth.csv", len(self.queries), len(self.references))
        truth = np.zeros((len(self.queries), len(self.references)), np.bool_)
        for query, true in enumerate(stated):
            truth[query, true] = True
        frames = [[decode(path.read_bytes()) for path in paths] for paths in (self.queries, self.references)]
        truth = corrected_truth(frames[0], frames[1], truth)
        places, driven = np.arange(len(self.references), dtype=np.float64), np.full(len(self.queries), np.nan)
        (first, middles), *again = sorted(passes(truth), key=lambda one: -len(one[1]))
        driven[first : first + len(middles)] = middles
        for begin, others in again:
            if len(others) > 20:  # the references of the circuit's first round, which these queries show as well
                around = driven[begin : begin + len(others)]
                steady = np.unique(around[np.isfinite(around)], return_index=True)[1]
                shifts = others[steady] + float(CIRCUIT[name]) - around[steady]
                places[CIRCUIT[name] :] += np.interp(places[CIRCUIT[name] :], around[steady], shifts)
        known = np.isfinite(driven)
        driven = np.interp(np.arange(len(driven)), np.flatnonzero(known), driven[known])
        on_curve = np.interp(driven, np.arange(len(places)), places)
        return places, gaussian_filter1d(on_curve, SMOOTHING, mode="nearest")


def answered(name: str, data: Path, folder: Path, seeds: Sequence[int]) -> Iterator[tuple[int, list[DriveFrame]]]:
    """Drive once with each odometry, by a service of its own; yield the seed and the drive."""
    traverse = Traverse(name, data)
    server = Server(folder / name, forked=False).wait()
    try:
        server.create_map("drive")
        for number, (path, pose) in enumerate(zip(traverse.references, traverse.places, strict=True)):
            where = {"x": pose.x, "y": pose.y, "heading": math.degrees(pose.yaw) % 360, "sequence": "first"}
            done = server.enrol("drive", f"r{number:04d}", path.read_bytes(), **where)
            assert done.status_code == 201, done.text
        with Client(f"http://127.0.0.1:{server.port}") as client:
            for seed in seeds:
                yield seed, _driven(client, traverse, odometry(traverse.true, seed))
    finally:
        server.stop()


def _driven(client: Client, traverse: Traverse, odom: Sequence[Planar]) -> list[DriveFrame]:
    drive = client.maps["drive"]
    radius, frames = float(drive.read().same_place_radius), []
    with drive.sessions.begin() as session:
        for number, (path, true, pose) in enumerate(zip(traverse.queries, traverse.true, odom, strict=True)):
            told = Odometry(pose.x, pose.y, math.degrees(pose.yaw))
            moment = START + timedelta(seconds=number)
            answer = session.send(path.read_bytes(), odometry=told, frame=number, timestamp=moment)
            as_json: dict[str, Any] = answer.model_dump(mode="json")
            frames.append(DriveFrame(true, pose, answer.verdict, estimate(as_json, radius)))
    return frames


def write(path: Path, drive: Sequence[DriveFrame]) -> None:
    """Write a drive as CSV, in metres and radians."""
    with path.open("w", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(COLUMNS)
        for one in drive:
            poses = [f"{value:.4f}" for pose in (one.true, one.odom) for value in (pose.x, pose.y, pose.yaw)]
            found: list[str] = []
            if one.found is not None:
                planar = one.found.planar
                found = [f"{value:.4f}" for value in (planar.x, planar.y, planar.yaw)]
                found += [f"{one.found.covariance[place]:.6g}" for place in FLAT]
            rows.writerow([*poses, one.verdict, "" if one.found is None else one.found.source, *found])


def read(path: Path) -> list[DriveFrame]:
    """Read a drive that was written."""
    drive = []
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            poses = [Planar(*(float(row[f"{kind}_{axis}"]) for axis in ("x", "y", "yaw"))) for kind in ("true", "odom")]
            found = None
            if row["source"]:
                covariance = np.zeros((6, 6))
                covariance.flat[list(FLAT)] = [float(row[name]) for name in COLUMNS[-6:]]
                whole = np.triu(covariance) + np.triu(covariance, 1).T
                planar = Planar(float(row["x"]), float(row["y"]), float(row["yaw"]))
                found = PoseEstimate(planar, tuple(whole.ravel().tolist()), row["source"])  # type: ignore[arg-type]
            drive.append(DriveFrame(poses[0], poses[1], row["verdict"], found))
    return drive
