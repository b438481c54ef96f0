"""Maps of many places that are quickly made, and waiting for the jobs of maps."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from tests.service.encoders import COARSE
from tests.service.scenes import encoded, jpeg, scene
from tests.service.server import Server


def finished(server: Server, job: Mapping[str, Any], seconds: float = 90) -> dict[str, Any]:
    """Wait until a job has ended; the job as it is then."""
    until = time.monotonic() + seconds
    while True:
        found: dict[str, Any] = server.client.get(f"/v1/jobs/{job['id']}?wait=20").json()
        if found["state"] not in ("queued", "running"):
            return found
        assert time.monotonic() < until, f"the job does not end: {found}"


def reaching(server: Server, job: Mapping[str, Any], least: int) -> dict[str, Any]:
    """Wait until a job has done so much, or has ended; the job as it is then."""
    until = time.monotonic() + 60
    while True:
        found: dict[str, Any] = server.client.get(f"/v1/jobs/{job['id']}").json()
        if found["progress"]["done"] >= least or found["state"] not in ("queued", "running"):
            return found
        assert time.monotonic() < until, f"no progress: {found}"


def wait_until(holds: Callable[[], bool]) -> None:
    """Wait for a condition that must become true."""
    end = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < end, "the condition did not become true"
        time.sleep(0.005)


def asked(server: Server, map_id: str, what: str, **body: Any) -> dict[str, Any]:
    """Submit a job for a map by POST; the job."""
    response = server.client.post(f"/v1/maps/{map_id}/{what}", json=body)
    assert response.status_code == 202, response.text
    job: dict[str, Any] = response.json()
    assert response.headers["location"] == f"/v1/jobs/{job['id']}"
    assert job["kind"] == what and job["map"] == map_id and job["resumable"]
    return job


def places(server: Server, map_id: str) -> dict[str, dict[str, Any]]:
    """Every place of a map by its id, in the order of enrolment."""
    items = server.client.get(f"/v1/maps/{map_id}/places?limit=1000").json()["items"]
    return {item["id"]: item for item in items}


def enrol_frames(server: Server, map_id: str, frames: Sequence[bytes], name: str = "p", **fields: Any) -> None:
    """Enrol places one metre apart, in batches; each place gets the fields."""
    for first in range(0, len(frames), 64):
        numbers = range(first, min(first + 64, len(frames)))
        files = {f"f{n}": (f"f{n}", frames[n], "image/jpeg") for n in numbers}
        listed = [{"id": f"{name}{n}", "file": f"f{n}", "x": n, "y": 0, **fields} for n in numbers]
        response = server.client.post(f"/v1/maps/{map_id}/places", data={"places": json.dumps(listed)}, files=files)
        assert response.status_code == 200, response.text
        assert all(item["status"] == 201 for item in response.json()["items"]), response.text


def enrol_many(server: Server, map_id: str, count: int, keep: str = "image", name: str = "p", **fields: Any) -> None:
    """Make a map of many places quickly: eight pictures, each enrolled several times with different bytes."""
    server.create_map(map_id, encoder=COARSE, keep=keep, verification=False)
    drawn = [jpeg(number) for number in range(8)]
    frames = [drawn[n % 8] + b"\x00" * (n + 1) for n in range(count)]
    enrol_frames(server, map_id, frames, name, **({"sequence": "monday"} | fields))


def walk_frames(count: int, per_scene: int = 4) -> list[bytes]:
    """Frames as of a walk: several in each scene, each a little more like the next scene."""
    return [_between(n // per_scene, (n % per_scene) / per_scene / 3) for n in range(count)]


def _between(seed: int, share: float) -> bytes:
    mixed = (1 - share) * scene(seed).astype(np.float32) + share * scene(seed + 1).astype(np.float32)
    return encoded(np.asarray(mixed, np.uint8))
