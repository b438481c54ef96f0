"""Half a year in which a real service learns.

    python -m benchmarks.learning.over_http --datasets ../shared/datasets

The runs of ``benchmarks.learning`` through the corridor, the attacker's among them, over HTTP: each is a session of a
robot with a key of its own, after which the service draws the lesson and takes looks by itself.  The examination asks
frame by frame, before the year and after it.  What a service stores of a look and what the benchmark in memory does
must lead to about the same figures (``python -m benchmarks.learning --short``).
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import cv2
import httpx
import numpy as np
import typer

from benchmarks.learning.__main__ import EXAMINED
from benchmarks.learning.worlds import RobotWorld, corridor
from benchmarks.learning.year import ATTACKER, RunMoment, RunPlan, curve, moments, year
from benchmarks.process import service
from benchmarks.report import report
from core.frames.preprocessing import Pixels

MAP = "/v1/maps/year"


def png(pixels: Pixels) -> bytes:
    """The file of a picture, without loss."""
    return cv2.imencode(".png", pixels)[1].tobytes()


class RobotFleet:
    """The robots of a year, and their operator.

    Args:
        client: of a service without keys.
    """

    def __init__(self, client: httpx.Client, world: RobotWorld, seed: int) -> None:
        self.client, self.world, self.seed = client, world, seed
        key = self._asked("POST", "/v1/keys", json={"name": "operator", "role": "admin"})["key"]
        client.headers["Authorization"] = f"Bearer {key}"

    def _asked(self, method: str, path: str, **request: Any) -> Any:
        answer = self.client.request(method, path, **request)
        answer.raise_for_status()
        return answer.json() if answer.content else None

    def map_world(self) -> None:
        """Enrol the first walk."""
        self._asked("POST", "/v1/maps", json={"id": "year", "learning": {"mode": "auto"}})
        points, headings = curve(self.world.spacing * np.arange(len(self.world.first)))
        for place, (pixels, point, heading) in enumerate(zip(self.world.first, points, headings, strict=True)):
            pose = {"x": point.real, "y": point.imag, "heading": math.degrees(heading), "sequence": "first"}
            self._asked("PUT", f"{MAP}/places/p{place}", params=pose, **self._frame(pixels))

    def _frame(self, pixels: Pixels) -> dict[str, Any]:
        return {"content": png(pixels), "headers": {"Content-Type": "image/png"}}

    def drive(self, plan: RunPlan) -> dict[str, Any]:
        """Make a run, and wait for its lesson."""
        made = {"name": f"{plan.robot}-{plan.number}", "role": "enrol", "learn": True}
        robot = {"Authorization": f"Bearer {self._asked('POST', '/v1/keys', json=made)['key']}"}
        session = self._asked("POST", f"{MAP}/sessions", json={}, headers=robot)["id"]
        for moment in moments(self.world, plan, self.seed):
            pose = moment.pose
            odometry = {"odometry_x": pose.x, "odometry_y": pose.y, "odometry_heading": math.degrees(pose.heading)}
            frame = self._frame(moment.pixels)
            frame["headers"] |= robot
            self._asked("POST", f"{MAP}/sessions/{session}/frames", params=odometry, **frame)
        self._asked("DELETE", f"{MAP}/sessions/{session}", headers=robot)
        return self._lesson(session)

    def _lesson(self, session: str) -> dict[str, Any]:
        while True:
            for job in self._asked("GET", "/v1/jobs")["items"]:
                if job["kind"] == "learn" and job["arguments"]["session"] == session:
                    if job["state"] in ("failed", "cancelled"):
                        raise RuntimeError(f"the lesson of {session} {job['state']}: {job}")
                    if job["state"] == "succeeded":
                        result: dict[str, Any] = job["result"]
                        return {**result, "session": session}
            time.sleep(0.2)

    def examine(self) -> dict[str, dict[str, int]]:
        """The frames of each condition, and how many are recognized rightly and wrongly."""
        found = {}
        for number, condition in enumerate(self.world.conditions):
            run = moments(self.world, RunPlan(EXAMINED + number, condition, "examiner"), self.seed)
            right = [self._right(moment) for moment in run]
            found[condition] = {"frames": len(run), "right": right.count(True), "wrong": right.count(False)}
        return found

    def _right(self, moment: RunMoment) -> bool | None:
        """Whether a frame is recognized rightly; None: it is not recognized."""
        place = self._asked("POST", f"{MAP}/query", params={"k": 1}, **self._frame(moment.pixels))["place"]
        if place is None:
            return None
        return moment.at is not None and bool(self.world.right[moment.at, int(place["id"][1:])])

    def looks(self) -> Iterator[dict[str, Any]]:
        """The looks that the map has learnt."""
        cursor: dict[str, str] = {}
        while True:
            page = self._asked("GET", f"{MAP}/looks", params={"limit": 100, **cursor})
            yield from page["items"]
            if page["next_cursor"] is None:
                return
            cursor = {"cursor": page["next_cursor"]}


def whole(exam: dict[str, dict[str, int]], part: str) -> int:
    """A count over all conditions."""
    return sum(one[part] for one in exam.values())


def lived(fleet: RobotFleet, plans: Sequence[RunPlan]) -> dict[str, Any]:
    """The figures of a year."""
    fleet.map_world()
    before = fleet.examine()
    attackers, told = set(), []
    for plan in plans:
        lesson = fleet.drive(plan)
        if ATTACKER in plan.events:
            attackers.add(lesson["session"])
        print(plan.number, plan.condition, *plan.events, {name: lesson.get(name) for name in COUNTED}, flush=True)
        told.append({"run": plan.number, "condition": plan.condition, "events": plan.events, "lesson": lesson})
    after, looks = fleet.examine(), list(fleet.looks())
    return {
        "runs": told,
        "before": before,
        "after": after,
        "looks": len(looks),
        "of the attacker": sum(look["run"] in attackers for look in looks),
        "sound": fleet.client.post(f"{MAP}/verify").json()["ok"],
    }


COUNTED = ("contradiction", "proposals", "taken", "withdrawn")


def main(
    datasets: Annotated[Path, typer.Option(help="Folder of the data sets.")] = Path("../shared/datasets"),
    runs: Annotated[int, typer.Option(help="Runs of the year, besides the attacker's.")] = 6,
    seed: Annotated[int, typer.Option(help="Of the runs.")] = 0,
) -> None:
    """Print a line for each run and a table, and store the figures."""
    world = corridor(datasets)
    with TemporaryDirectory() as folder, service(Path(folder) / "data", log=Path(folder) / "log") as process:
        found = lived(RobotFleet(process.client, world, seed), year(world, runs))
    rows = [
        [when, *(whole(found[when], part) for part in ("frames", "right", "wrong"))] for when in ("before", "after")
    ]
    report("learning-over-http", f"The corridor: {runs} runs over HTTP", ["", "frames", "right", "wrong"], rows, found)
    print(f"{found['looks']} looks, {found['of the attacker']} of the attacker; sound: {found['sound']}")


if __name__ == "__main__":
    typer.run(main)
