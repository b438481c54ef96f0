"""The time of the first request of a kind in an opened map of a service that has just started, beside its steady time.

Numba's cache is an empty folder at the beginning, which the rehearsal of the first start fills, as the build of an
image does.  Each kind of request then has a service of its own, whose maps one listing of places has opened.

python -m benchmarks.day.first_requests
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import httpx
import typer

from benchmarks.process import Process, median, service
from benchmarks.report import report, verdict
from service.commands.timing.samples import jpeg, sample_frame

PLACES = 12
"""Of each traverse."""

EXTRA_SECONDS = 0.2
"""By which a first request may exceed its steady time."""

WIDTH = 600
"""Of the frames, in pixels."""

CAMERA = "front"

START = 1_764_000_000
JPEG = {"Content-Type": "image/jpeg"}

Request = Callable[[int], object]


def view(number: int, step: int = 0) -> bytes:
    """The JPEG file of a frame at a place, seen a few pixels aside."""
    return jpeg(sample_frame(number)[:, 8 * step : WIDTH + 8 * step])


def moment(number: int) -> str:
    """The time of a frame, in RFC 3339."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(START + number))


def enrol(client: httpx.Client) -> None:
    """Two maps of the same two traverses: ``posed`` has poses, times and intrinsics, ``plain`` has none of them."""
    for name in ("posed", "plain"):
        client.post("/v1/maps", json={"id": name, "same_place_frames": 1}).raise_for_status()
        if name == "posed":
            height = sample_frame(0).shape[0]
            pinhole = {"width": WIDTH, "height": height, "fx": 500, "fy": 500, "cx": WIDTH / 2, "cy": height / 2}
            client.put(f"/v1/maps/posed/cameras/{CAMERA}", json={"intrinsics": pinhole}).raise_for_status()
        for step, sequence in enumerate(("monday", "tuesday")):
            for number in range(PLACES):
                about: dict[str, str | float] = {"sequence": sequence}
                if name == "posed":
                    about |= {"x": 5.0 * number, "y": 1.0 * step, "heading": 0.0, "timestamp": moment(number)}
                    about["camera"] = CAMERA
                path = f"/v1/maps/{name}/places/{sequence}-{number}"
                client.put(path, params=about, content=view(number, step), headers=JPEG).raise_for_status()


def kinds(client: httpx.Client) -> dict[str, Callable[[], Request]]:
    """For each kind of request what prepares it and returns the request; this is called with 0, 1, 2, …"""

    def post(path: str, **options: object) -> Request:
        def request(number: int) -> httpx.Response:
            content = {} if "json" in options else {"content": view(number, 2), "headers": JPEG}
            return client.post(path, **content, **options).raise_for_status()  # type: ignore[arg-type]

        return request

    def session(name: str, options: dict[str, object], motion: dict[str, str | float]) -> Request:
        path = f"/v1/maps/{name}/sessions"
        identity = client.post(path, json=options).raise_for_status().json()["id"]

        def request(number: int) -> httpx.Response:
            about = {"timestamp": moment(number), **(motion if number else {})}
            answer = client.post(f"{path}/{identity}/frames", params=about, content=view(number, 2), headers=JPEG)
            return answer.raise_for_status()

        # The first frame moves nothing: a motion is first given with the second one.
        request(0)
        return lambda number: request(number + 1)

    def get(path: str, **parameters: str) -> Request:
        return lambda _: client.get(path, params=parameters).raise_for_status()

    def put(number: int) -> httpx.Response:
        path = f"/v1/maps/posed/places/new-{number}"
        return client.put(path, content=view(number, 3), headers=JPEG).raise_for_status()

    def enrolling(number: int) -> httpx.Response:
        about = {"id": f"seen-{number}"}
        path = "/v1/maps/posed/query:enrol"
        return client.post(path, params=about, content=view(number, 2), headers=JPEG).raise_for_status()

    def two(number: int) -> httpx.Response:
        files = {"a": view(number), "b": view(number, 2)}
        return client.post("/v1/match", files=files).raise_for_status()

    def job(path: str, body: dict[str, object]) -> Request:
        def request(_: int) -> None:
            answer = client.post(path, json=body).raise_for_status()
            if answer.status_code != httpx.codes.ACCEPTED:  # a small calibration is answered at once
                return
            found = answer.json()
            while found["state"] in ("queued", "running"):
                found = client.get(f"/v1/jobs/{found['id']}", params={"wait": 10}).raise_for_status().json()
            if found["state"] != "succeeded":
                raise RuntimeError(f"the job {found['kind']} is {found['state']}: {found}")

        return request

    order = {
        "method": "sequence",
        "sequence": "tuesday",
        "target": {"rule": "precision", "value": 0.5},
        "dry_run": True,
    }
    odometry: dict[str, str | float] = {"forward": 5.0, "left": 0.0, "turn": 0.0, "deviation": 0.3}
    return {
        "query, never": lambda: post("/v1/maps/posed/query", params={"verify": "never"}),
        "query, auto": lambda: post("/v1/maps/posed/query"),
        "query, always": lambda: post("/v1/maps/posed/query", params={"verify": "always"}),
        "query, by intrinsics": lambda: post("/v1/maps/posed/query", params={"verify": "always", "camera": CAMERA}),
        "query, explained": lambda: post("/v1/maps/posed/query", params={"explain": True, "verify": "always"}),
        "query of two maps": lambda: post("/v1/query", params={"maps": "posed,plain"}),
        "query or enrol": lambda: enrolling,
        "frame of a session": lambda: session("plain", {}, {}),
        "frame with odometry": lambda: session("posed", {"lag": 2}, odometry),
        "frame with a speed limit": lambda: session("posed", {"speed_limit": 6.0, "lag": 2}, {}),
        "enrolment": lambda: put,
        "encode": lambda: post("/v1/encode"),
        "regions": lambda: post("/v1/regions"),
        "match": lambda: two,
        "plan": lambda: get("/v1/maps/posed/plan"),
        "health": lambda: get("/v1/maps/plain/health"),
        "similarity": lambda: get("/v1/maps/plain/similarity", query="monday", reference="tuesday"),
        "alignment": lambda: job("/v1/maps/plain/align", {"sequence": "tuesday", "with": ["monday"], "dry_run": True}),
        "calibration": lambda: job("/v1/maps/posed/calibrate", order),
        "pruning": lambda: job("/v1/maps/plain/prune", {"dry_run": True}),
    }


@contextmanager
def opened(data_dir: Path) -> Iterator[Process]:
    """A service whose two maps are open."""
    with service(data_dir) as process:
        for name in ("posed", "plain"):
            process.client.get(f"/v1/maps/{name}/places", params={"limit": 1}).raise_for_status()
        yield process


def main(
    rounds: Annotated[int, typer.Option(min=1, help="Requests after the first, whose median is the steady time.")] = 7,
    only: Annotated[list[str] | None, typer.Option("--kind", help="Only these kinds.")] = None,
) -> None:
    """Compare the first request of each kind with the median of the next ones."""
    rows, figures = [], {}
    with tempfile.TemporaryDirectory() as folder:
        os.environ["NUMBA_CACHE_DIR"] = str(Path(folder) / "numba")
        data_dir = Path(folder) / "data"
        with service(data_dir) as process:
            first_start = process.ready
            enrol(process.client)
            names = list(kinds(process.client))
        starts = []
        for name in only or names:
            with opened(data_dir) as process:
                starts.append(process.ready)
                request = kinds(process.client)[name]()
                times = []
                for number in range(rounds + 1):
                    began = time.perf_counter()
                    request(number)
                    times.append(time.perf_counter() - began)
            steady = median(times[1:])
            figures[name] = {"first": times[0], "steady": steady}
            rows.append((name, 1e3 * times[0], 1e3 * steady, verdict(times[0] - steady, EXTRA_SECONDS)))
    rows.append(("start, nothing compiled, s", first_start, median(starts), "compiled"))
    figures["start"] = {"empty cache": first_start, "compiled": median(starts)}
    report("first_requests", "First requests", ["", "first, ms", "steady, ms", "difference, s"], rows, figures)


if __name__ == "__main__":
    typer.run(main)
