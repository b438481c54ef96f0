"""A data directory of placerec 0.1.0, as a SIGKILL left it: this version uses it as it is (``fixtures/README.md``)."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from core.belief import from_bytes
from service.sessions.store import SessionStore
from tests.service.server import ROOT, Server

FIXTURE = Path(__file__).parent / "fixtures" / "data-0.1.0.tar.xz"


def unpacked(folder: Path) -> dict[str, Any]:
    """Write the fixture's files below ``folder``; what the service of that time said of them."""
    expected: dict[str, Any] = {}
    with tarfile.open(FIXTURE, "r:xz") as archive:
        for member in archive:
            file = archive.extractfile(member)
            if file is None:
                continue
            if member.name == "expected.json":
                expected = json.load(io.TextIOWrapper(file, "utf-8"))
                continue
            target = folder / member.name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read())
            target.chmod(0o600)
    return expected


def check(server: Server, expected: dict[str, Any], pictures: Path) -> None:
    """Maps, places, answers, jobs and statistics as they were."""
    for map_id, record in expected["maps"].items():
        found = server.client.get(f"/v1/maps/{map_id}").json()
        calibration, known = found["calibration"], record["calibration"]
        assert {name: found[name] for name in record if name != "calibration"} == {
            name: value for name, value in record.items() if name != "calibration"
        }
        if known["source"] == "encoder-default":  # today's says more about small maps and geometry
            assert calibration["environment"] is not None
            calibration["curve"] = {name: calibration["curve"][name] for name in known["curve"]}
            calibration.pop("environment")
            calibration.pop("geometry")
        assert calibration == known
        known_places = [{**place, "pose_of": None} for place in expected["places"][map_id]]
        assert list(server.places(map_id).values()) == known_places
    for name, known in expected["answers"].items():
        map_id, picture = name.split("/")
        answer = server.query(map_id, (pictures / "camera" / f"{picture}.jpg").read_bytes())
        assert (answer["verdict"], answer["place"] and answer["place"]["id"]) == (known["verdict"], known["place"])
        # Places without pose and sequence are their own places since, and the default knows more of small maps.
        assert answer["probability"] == pytest.approx(known["probability"], abs=0.15)
    for job in expected["jobs"]:
        assert server.client.get(f"/v1/jobs/{job}").json()["state"] == "succeeded"


@contextmanager
def stopped_at_the_end(server: Server) -> Iterator[Server]:
    try:
        yield server
    finally:
        if server.process.poll() is None:
            server.kill()


def test_it_is_used_as_it_is(tmp_path: Path) -> None:
    expected = unpacked(tmp_path)
    subprocess.run([sys.executable, ROOT / "examples" / "make_pictures.py", tmp_path / "pictures"], check=True)
    pictures = tmp_path / "pictures"
    store = SessionStore(tmp_path / "data")
    session = store.read(expected["session"]["id"])
    assert session is not None and session.state is not None
    assert from_bytes(session.state).frames == expected["session"]["frames"]
    store.close()

    with stopped_at_the_end(Server(tmp_path, key=expected["key"])) as server:
        server.wait()
        counted = server.client.get("/v1/maps/lab/health").json()["answers"]
        assert counted["queries"] == expected["queries"]
        check(server, expected, pictures)
        assert server.client.get("/v1/maps/lab/places/yard/thumbnail").content.startswith(b"\xff\xd8")
        assert server.enrol("packed", "street", (pictures / "camera" / "4-street.jpg").read_bytes()).status_code == 201
        server.kill()

    with stopped_at_the_end(Server(tmp_path, key=expected["key"])) as server:
        server.wait()
        assert list(server.places("packed")) == [place["id"] for place in expected["places"]["packed"]] + ["street"]
        for map_id in expected["maps"]:
            report = server.client.post(f"/v1/maps/{map_id}/verify").json()
            assert (report["ok"], report["problems"]) == (True, [])
        assert server.stop() == 0
