"""Half an hour of mixed load on one server: does it stay as quick and as small as it was at first?

    python -m benchmarks.endurance                      # 30 minutes; the machine must have nothing else to do
    python -m benchmarks.endurance --minutes 3          # a look
    python -m benchmarks.endurance --rate 0             # robots that send their next frame at once

16 robots query at a fixed rate, two operators enrol, one deletes as much as they enrol, and someone lists, verifies and
(where the service can) exports the map, while the process is looked at from outside every five seconds.  Wanted: no
answer but those expected, every enrolled place found and no deleted one; p99 of the last sixth at most 1.2 times that
of the first; memory, open files, threads and disk that do not grow.  Robots and service share the machine's cores.
"""

from __future__ import annotations

import asyncio
import json
import os
import tempfile
import threading
import time
from pathlib import Path
from typing import Annotated, Any

import cv2
import httpx
import numpy as np
import typer
from numpy.typing import NDArray

from benchmarks.fleet import Fleet, Scene, Seen, Workload
from benchmarks.process import service
from benchmarks.report import report, verdict
from service.commands.timing.samples import jpeg, sample_frame

MAP = "endurance"
SAMPLE_SECONDS = 5.0
TAIL_LIMIT = 1.2
GROWTH_LIMIT = 1.05
"""Of the least memory and disk of the last third against that of the first: both rise and fall with the segments."""
MORE_LIMIT = 2
"""Threads and open files more in the last third than in the first, medians."""


class ProcessWatch(threading.Thread):
    """Looks at a process and a folder from outside."""

    def __init__(self, pid: int, folder: Path, fleet: Fleet) -> None:
        """Not begun yet."""
        super().__init__(name="watch", daemon=True)
        self.samples: list[dict[str, float]] = []
        self._pid, self._folder, self._fleet = pid, folder, fleet
        self._ended = threading.Event()

    def run(self) -> None:
        """Take samples until the end."""
        while not self._ended.wait(SAMPLE_SECONDS):
            self.samples.append(self._sample())

    def end(self) -> None:
        """Take no more."""
        self._ended.set()
        self.join()

    def _sample(self) -> dict[str, float]:
        lines = Path(f"/proc/{self._pid}/status").read_text().splitlines()
        status = {name: value.split() for name, _, value in (line.partition(":") for line in lines)}
        links = []
        for link in Path(f"/proc/{self._pid}/fd").iterdir():
            try:
                links.append(os.readlink(link))
            except OSError:
                continue  # closed meanwhile
        return {
            "at": time.perf_counter(),
            "resident_mb": int(status["VmRSS"][0]) * 1024 / 1e6,
            "threads": int(status["Threads"][0]),
            "files": len(links),
            "connections": sum(link.startswith("socket:") for link in links),
            "disk_mb": sum(size_of(path) for path in self._folder.rglob("*")) / 1e6,
            "places": self._fleet.alive(),
        }


def size_of(path: Path) -> int:
    """Bytes of a file; 0 if it is none or has gone."""
    try:
        return path.stat().st_size if path.is_file() else 0
    except OSError:
        return 0


def draw(number: int) -> Scene:
    """A sample frame, and the same a little darker and as another file."""
    drawn = sample_frame(number)
    darker: NDArray[np.uint8] = cv2.convertScaleAbs(drawn, alpha=0.85)  # type: ignore[assignment]
    return Scene(jpeg(drawn, 85), jpeg(darker, 75))


def enrol_fixed(client: httpx.Client, scenes: list[Scene]) -> None:
    """The places that stay, one multipart form after the other."""
    for start in range(0, len(scenes), 32):
        names = [f"fixed-{start + offset:05d}" for offset in range(len(scenes[start : start + 32]))]
        entries = json.dumps([{"id": name, "file": name, "sequence": "fixed"} for name in names]).encode()
        files: list[tuple[str, Any]] = [("places", (None, entries, "application/json"))]
        for offset, name in enumerate(names):
            files.append((name, (name, scenes[start + offset].enrolled, "image/jpeg")))
        response = client.post(f"/v1/maps/{MAP}/places", files=files)
        response.raise_for_status()
        assert all(item["status"] == 201 for item in response.json()["items"])


def milliseconds(times: list[tuple[float, float]], start: float, stop: float, percent: float) -> float:
    """A percentile of the answers to what was due in a stretch of time."""
    found = [spent for due, spent in times if start <= due < stop]
    return 1e3 * float(np.percentile(found, percent)) if found else float("nan")


def growth(samples: list[dict[str, float]], name: str) -> dict[str, float]:
    """How a measure went: least and median of the first and the last third, and the slope of all of it an hour."""
    values = np.array([sample[name] for sample in samples])
    hours = np.array([sample["at"] for sample in samples]) / 3600
    third = max(1, len(values) // 3)
    return {
        "first": float(values[:third].min()),
        "last": float(values[-third:].min()),
        "first_median": float(np.median(values[:third])),
        "last_median": float(np.median(values[-third:])),
        "most": float(values.max()),
        "slope_per_hour": float(np.polyfit(hours - hours[0], values, 1)[0]) if len(values) > 1 else 0.0,
    }


def judge(seen: Seen, samples: list[dict[str, float]], start: float, stop: float) -> tuple[list[Any], dict[str, Any]]:
    """The table's rows and the figures of a run."""
    sixth = (stop - start) / 6
    rows: list[Any] = []
    figures: dict[str, Any] = {"requests": {}, "statuses": dict(seen.statuses), "verdicts": dict(seen.verdicts)}
    for kind, times in sorted(seen.times.items()):
        of_all = {f"p{percent}": milliseconds(times, start, stop, percent) for percent in (50, 99)}
        of_all["worst"] = milliseconds(times, start, stop, 100)
        figures["requests"][kind] = {"count": sum(start <= due < stop for due, _ in times), **of_all}
        shown = f"{of_all['p50']:.1f} / {of_all['p99']:.1f} / {of_all['worst']:.0f} ms"
        rows.append((kind, figures["requests"][kind]["count"], shown, ""))
    queries = seen.times["query"]
    figures["p99_by_sixth"] = [milliseconds(queries, start + i * sixth, start + (i + 1) * sixth, 99) for i in range(6)]
    first, last = figures["p99_by_sixth"][0], figures["p99_by_sixth"][-1]
    rows.append(
        ("p99 of queries, first and last sixth", "", f"{first:.1f}, {last:.1f} ms", _bar(last / first, TAIL_LIMIT))
    )
    figures["growth"] = {name: growth(samples, name) for name in samples[0] if name != "at"}
    for name, unit in (("resident_mb", "MB"), ("disk_mb", "MB")):
        one = figures["growth"][name]
        trend = f"{one['first']:.0f}, {one['last']:.0f} {unit} (most {one['most']:.0f}, {one['slope_per_hour']:+.0f}/h)"
        what = f"{name.split('_')[0]}: least of first and last third"
        rows.append((what, "", trend, _bar(one["last"] / one["first"], GROWTH_LIMIT)))
    for name in ("files", "connections", "threads", "places"):
        one = figures["growth"][name]
        bar = "" if name == "places" else verdict(one["last_median"] - one["first_median"], MORE_LIMIT)
        rows.append(
            (
                f"{name}: medians of first and last third",
                "",
                f"{one['first_median']:.0f}, {one['last_median']:.0f}",
                bar,
            )
        )
    rows.append(("unexpected errors", sum(seen.complaints.values()), "", verdict(sum(seen.complaints.values()), 0)))
    figures["complaints"] = dict(seen.complaints)
    return rows, figures


def _bar(ratio: float, limit: float) -> str:
    return f"{ratio:.2f}, {verdict(ratio, limit)}"


def main(
    minutes: Annotated[float, typer.Option(min=0.2, help="Measured; a warm-up of a tenth comes before it.")] = 30.0,
    robots: Annotated[int, typer.Option(min=1)] = 16,
    rate: Annotated[float, typer.Option(min=0, help="Frames a second of each robot; 0: as fast as answered.")] = 3.0,
    operators: Annotated[int, typer.Option(min=1)] = 2,
    enrol_rate: Annotated[float, typer.Option(min=0.1, help="Frames a second of each operator.")] = 2.0,
    places: Annotated[int, typer.Option(min=16, help="That stay; those that come and go are about 400 more.")] = 500,
) -> None:
    """Measure, and end with 1 if a bar is missed."""
    scenes = [draw(number) for number in range(places + 300 * operators)]
    strangers = [draw(100_000 + number).seen for number in range(60)]
    fixed = {f"fixed-{number:05d}": number for number in range(places)}
    settings = {"EXPORT_SECONDS": 30}  # the file of an export is stored for this time
    with (
        tempfile.TemporaryDirectory() as text,
        service(Path(text) / "data", settings=settings, log=Path(text) / "log") as process,
    ):
        client = process.client
        client.post("/v1/maps", json={"id": MAP}).raise_for_status()
        enrol_fixed(client, scenes[:places])
        exports = "/v1/maps/{map}/export" in client.get("/openapi.json").json()["paths"]
        plan = Workload(str(client.base_url), MAP, scenes, strangers, fixed, robots, operators, rate, enrol_rate)
        fleet = Fleet(plan)
        watch = ProcessWatch(process.pid, Path(text) / "data", fleet)

        async def run() -> tuple[float, float]:
            await fleet.fill()
            began = time.perf_counter() + 6 * minutes
            watch.start()
            await fleet.work(66 * minutes, exports)
            return began, time.perf_counter()

        start, stop = asyncio.run(run())
        watch.end()
        held = client.get(f"/v1/maps/{MAP}").json()["places"]
        if held != fleet.alive():
            fleet.seen.complaints[f"the map holds {held} places where {fleet.alive()} were acknowledged"] += 1
        if fleet.unsent:
            fleet.seen.complaints["frames that were due were not sent, as the answers before came too late"] += (
                fleet.unsent
            )
        memory = process.peak_memory()
    samples = [sample for sample in watch.samples if sample["at"] >= start]
    rows, figures = judge(fleet.seen, samples, start, stop)
    speed = f"{rate:g} frames/s" if rate else "full speed"
    title = f"{minutes:g} minutes: {robots} robots at {speed}, {operators} operators at {enrol_rate:g} frames/s"
    figures |= {"minutes": minutes, "robots": robots, "rate": rate, "exports": exports, "peak_mb": memory}
    figures["samples"] = [{name: round(value, 2) for name, value in sample.items()} for sample in samples]
    name = "endurance" if rate else "endurance-saturated"
    report(name, title, ("what", "count", "p50 / p99 / worst, or found", "bar"), rows, figures)
    for complaint, times in fleet.seen.complaints.most_common(10):
        print(f"{times} × {complaint}")
    if any("MISSED" in str(row[-1]) for row in rows):
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
