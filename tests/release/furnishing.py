"""The fixtures of a release: a data directory, an exported map, and a conversation, made by the code as it stands.

    scripts/fixtures 1.0.0     # writes tests/fixtures/1.0.0

The pictures are drawn.  ``test_fixtures`` holds every later version to the fixtures of all releases.
"""

from __future__ import annotations

import hashlib
import json
import lzma
import shutil
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from core.ledger import Tables
from core.ledger.maps import schema
from core.store.directory import FORMAT
from placerec_client import Client, Map, NewPlace
from service.access import key_table
from service.access.keys import Keys
from service.jobs import rows
from service.queries import count_tables
from service.sessions import table
from service.telemetry import history
from tests.release.conversation import Recorder, text_of
from tests.release.surface import surface
from tests.service.scenes import encoded, jpeg, scene, seen_again, stranger
from tests.service.server import ROOT, Server

FIXTURES = ROOT / "tests/fixtures"
DATA, ARCHIVE, CONVERSATION, ABOUT = "data.tar.xz", "hall.tar", "conversation.json", "about.json"
SURFACE, INTERFACE = "surface.json", "openapi.json.xz"

TABLES: dict[str, Tables] = {
    "map": schema.TABLES,
    "jobs": rows.TABLES,
    "keys": key_table.TABLES,
    "sessions": table.TABLES,
    "statistics": count_tables.TABLES,
    "history": history.TABLES,
}
"""The tables of all files of a data directory."""

FOREVER = {"review_days": 0, "answer_days": 0, "event_days": 0, "audit_days": 0}
"""Settings under which a fixture does not age."""


def forms() -> dict[str, int]:
    """The schemas of today's files."""
    return {name: one.version for name, one in TABLES.items()}


def again(number: int) -> bytes:
    """A place seen another day."""
    return encoded(seen_again(scene(number), number))


def elsewhere(number: int) -> bytes:
    """A place that no map has."""
    return encoded(stranger(number))


def furnish(client: Client) -> None:
    """Make maps with all that a data directory may have."""
    review: Any = {"verdicts": ["recognized", "ambiguous", "unknown"], "most_frames": 8}
    hall = client.maps.create("hall", keep="image", description="a hall", review=review, same_place_radius=1.0)
    hall.cameras.put("front", mask={"polygons": [[(0, 0.9), (1, 0.9), (1, 1)]]})
    for number in range(4):
        hall.places.put(
            f"p{number}", jpeg(number), x=2.0 * number, y=0.0, heading=90.0, sequence="monday",
            timestamp="2026-11-20T10:00:00Z", metadata={"floor": number},
        )  # fmt: skip
    hall.places.add_look("p1", again(1), timestamp="2026-11-20T22:00:00Z")
    for number in (0, 1):
        hall.query(again(number))
    hall.query(elsewhere(40))
    kept = _kept(hall, 3)
    hall.review.label(kept[0], place="p1")
    attic = client.maps.create("attic", precision="compressed", keep="none", verification=False)
    for number in range(2):
        attic.places.put(f"a{number}", jpeg(10 + number), latitude=48.85, longitude=2.35 + number / 1000)
    hall.rebuild().wait()
    attic.verify(background=True).wait()
    client.keys.create("robot-7", "query", maps=["hall"])
    hall.sessions.begin(advance=1).begin().send(again(0))


def _kept(hall: Map, count: int) -> list[int]:
    until = time.monotonic() + 60
    while len(kept := [one.id for one in hall.review]) < count and time.monotonic() < until:
        time.sleep(0.05)
    assert len(kept) == count
    return kept


def converse(client: Client) -> None:
    """Ask for what was stored, and change it, as a robot's and an operator's programs do."""
    assert client.liveness().status == "ok" and client.version().name == "placerec"
    assert client.own_key().role == "admin" and [one.name for one in client.keys]
    hall, attic = client.maps["hall"], client.maps["attic"]
    assert {one.id for one in client.maps} == {"hall", "attic"} and hall.read().description == "a hall"
    assert [one.id for one in hall.places.list(sequence="monday")] == ["p0", "p1", "p2", "p3"]
    assert hall.places.read("p1").pose and [one.name for one in hall.places.looks("p1")]
    assert hall.places.thumbnail("p2") and [one.name for one in hall.cameras] == ["front"]
    assert [one.place for one in hall.review.labels()] == ["p1"] and len(list(hall.review)) >= 2
    assert [one.name for one in hall.sequences] == ["monday"] and hall.plan().places == 4
    assert {job.kind for job in client.jobs} >= {"rebuild", "verify"}
    for number in range(4):
        answer = hall.query(again(number), k=3)
        assert answer.verdict == "recognized" and answer.place and answer.place.id == f"p{number}"
    assert hall.query(elsewhere(50)).verdict == "unknown"
    assert hall.query(again(2), k=2, explain=True, camera="front", where={"floor": 2}).place
    assert attic.query(jpeg(11)).place and client.query(again(3), maps="hall").place
    assert [one.answer and one.answer.verdict for one in hall.query_batch([again(0), again(3)])] == ["recognized"] * 2
    assert hall.query_or_enrol("p9", elsewhere(60), sequence="tuesday", x=20.0, y=0.0).enrolment == "created"
    assert hall.places.put("p3", jpeg(3), x=6.5, y=0.0, sequence="monday").change == "updated"
    assert hall.places.edit("p3", {"metadata": {"door": "red"}}).metadata == {"door": "red"}
    assert hall.coverage(x=2.2, y=0.0).state == "covered" and hall.calibration(threshold=0.5).map == "hall"
    edited = hall.edit({"description": "the hall"}, if_match=hall.read().revision)
    assert edited.description == "the hall"
    administer(client, hall)
    with hall.sessions.begin(advance=1) as run:
        for number in (0, 1, 2):
            run.send(again(number), forward=2.0)
        assert run.read().frames == 3
    assert hall.verify().ok and hall.rebuild().wait().state == "succeeded" and hall.health(limit=3).map == "hall"
    assert len(client.encode(jpeg(1)).descriptor) > 100 and client.match(jpeg(1), again(1)).score
    hall.places.delete("p9")
    assert hall.sequences.delete("monday").places == 4 and hall.read().places == 0
    attic.delete()


def administer(client: Client, hall: Map) -> None:
    """Change what operators change, and leave the places that there were; nothing in it ages."""
    assert hall.cameras.put("rear", mask={"polygons": [[(0, 0), (1, 0), (1, 0.1)]]}).name == "rear"
    assert hall.cameras.read("rear").mask
    hall.cameras.delete("rear")
    (look,) = [one.name for one in hall.places.looks("p1")]
    assert hall.places.look_thumbnail("p1", look) and [one.name for one in hall.places.all_looks()] == [look]
    hall.places.delete_look("p1", look)
    batch = [NewPlace(f"p{number}", elsewhere(number), {"sequence": "tuesday"}) for number in (7, 8)]
    assert [one.change for one in hall.enrol(batch, known=())] == ["created"] * 2
    assert hall.places.delete_many(ids=["p7"], dry_run=False).ids == ["p7"]
    assert hall.erase(ids=["p8"]).wait().state == "succeeded"
    assert hall.keypoints().wait().state == "succeeded"
    assert hall.answers().items and hall.places.matches("p0").items and client.regions(jpeg(0))
    frame = next(one.id for one in hall.review)
    assert hall.review.picture(frame) and hall.review.label(frame, discard=True).discarded
    assert hall.review.stretches() == [] and any(one.default for one in client.encoders.list())
    made = client.keys.create("robot-8", "enrol", maps=["hall"])
    assert client.keys.read(made.id).name == "robot-8"
    assert client.keys.narrow(made.id, {"role": "query"}).role == "query" and client.keys.delete(made.id).id == made.id


@contextmanager
def serving(data: Path, folder: Path, key: str) -> Iterator[Server]:
    """A service on a data directory, with a log and whatever else it writes in another folder."""
    running = Server(folder, {**FOREVER, "data_dir": data}, key=key).wait()
    try:
        yield running
    finally:
        assert running.stop() == 0


def unpacked(release: Path, folder: Path) -> Path:
    """A copy of the data directory of a release."""
    with tarfile.open(release / DATA) as archive:
        archive.extractall(folder, filter="data")
    for path in (folder / "data").rglob("*"):
        path.chmod(0o700 if path.is_dir() else 0o600)
    return folder / "data"


def pack(data: Path, target: Path) -> None:
    """A data directory as an archive in which nothing names who made it."""

    def anonymous(member: tarfile.TarInfo) -> tarfile.TarInfo:
        member.uid = member.gid = 0
        member.uname = member.gname = ""
        return member

    with tarfile.open(target, "w:xz", preset=9) as archive:
        archive.add(data, "data", filter=anonymous)


def write(version: str, fixtures: Path = FIXTURES) -> Path:
    """Write the fixtures of a version anew; their folder."""
    release = fixtures / version
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data, made = folder / "data", folder / "made"
        data.mkdir(mode=0o700)
        made.mkdir()
        _, key = Keys.of(data).create("ann", "admin")
        with serving(data, folder / "first", key) as running, Client(str(running.client.base_url), key=key) as client:
            furnish(client)
            client.maps["hall"].export(made / ARCHIVE)
        pack(data, made / DATA)
        recorder = Recorder()
        with (
            serving(data, folder / "second", key) as running,
            Client(str(running.client.base_url), key=key, transport=recorder) as client,
        ):
            converse(client)
            metrics = running.client.get("/metrics").text
        (made / CONVERSATION).write_text(text_of(recorder.exchanges))
        (made / SURFACE).write_text(json.dumps(surface(metrics), indent=1) + "\n")
        (made / INTERFACE).write_bytes(lzma.compress((ROOT / "openapi.json").read_bytes(), preset=9))
        digests = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(made.iterdir())}
        about = {"version": version, "key": key, "format": FORMAT, "forms": forms(), "sha256": digests}
        (made / ABOUT).write_text(json.dumps(about, indent=2) + "\n")
        shutil.rmtree(release, ignore_errors=True)
        release.parent.mkdir(exist_ok=True)
        shutil.move(made, release)
    return release


if __name__ == "__main__":
    for path in sorted(write(sys.argv[1]).iterdir()):
        print(f"{path.relative_to(ROOT)}  {path.stat().st_size / 1e3:.0f} kB")
