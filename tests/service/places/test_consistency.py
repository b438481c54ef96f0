"""Many clients at once, who write, merge, prune, delete and make again the same maps: nothing lost, nothing twice.

What they do is drawn with a seed, which a failure shows; what is true afterwards must follow from what was answered.
"""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.service.encoders import COARSE, install_coarse_encoder
from tests.service.map_jobs import finished, places
from tests.service.places.test_bulk_enrolment import traverse
from tests.service.scenes import jpeg
from tests.service.server import Server

SECONDS = 3.0
FRAMES = [jpeg(number, 160, 120) for number in range(6)]


@pytest.fixture(scope="module")
def busy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("busy")
    install_coarse_encoder(folder / "models")
    server = Server(folder, {"job_workers": 2, "queue_length": 200, "job_queue": 500, "job_history": 1000}).wait()
    yield server
    assert server.stop() == 0
    failures = [line for line in server.lines(level="error") if "status" not in line or line["status"] == 500]
    assert not failures, failures


@dataclass
class Crowd:
    """Threads of clients, each with a generator and a connection of its own; what surprised one of them."""

    server: Server
    seed: int
    surprises: list[str] = field(default_factory=list)
    threads: list[threading.Thread] = field(default_factory=list)

    def add(self, work: Callable[[httpx.Client, random.Random], None]) -> None:
        number = len(self.threads)

        def run() -> None:
            drawn = random.Random(f"{self.seed}-{number}")
            try:
                with httpx.Client(base_url=str(self.server.client.base_url), timeout=60) as client:
                    while time.monotonic() < self.until:
                        work(client, drawn)
            except Exception as error:
                self.surprises.append(f"client {number}: {error!r}")

        self.threads.append(threading.Thread(target=run))

    def go(self, seconds: float = SECONDS) -> None:
        self.until = time.monotonic() + seconds
        for thread in self.threads:
            thread.start()
        for thread in self.threads:
            thread.join()
        assert not self.surprises, f"seed {self.seed}: {self.surprises}"


def expect(response: httpx.Response, *statuses: int) -> Any:
    assert response.status_code in statuses, response.text
    return response.json() if response.content else None


def put(client: httpx.Client, map_id: str, place: str, data: bytes, **fields: Any) -> httpx.Response:
    header = {"Content-Type": "image/jpeg"}
    return client.put(f"/v1/maps/{map_id}/places/{place}", params=fields, content=data, headers=header)


def check_whole(server: Server, map_id: str) -> dict[str, dict[str, Any]]:
    """All places of a map, which agree with what is counted, searched and stored."""
    found = places(server, map_id)
    shown = server.client.get(f"/v1/maps/{map_id}").json()
    listed = server.client.get(f"/v1/maps/{map_id}/sequences").json()["items"]
    report = server.client.post(f"/v1/maps/{map_id}/verify").json()
    assert report["ok"], report
    assert shown["places"] == report["places"] == len(found)
    assert sum(sequence["places"] for sequence in listed) <= len(found)
    return found


@pytest.mark.thorough
def test_writers_merges_and_prunes_of_one_map(busy: Server) -> None:
    seed = 20261121
    busy.create_map("hub", encoder=COARSE)
    busy.create_map("annex", encoder=COARSE)
    for number in range(40):
        expect(busy.enrol("annex", f"a{number}", FRAMES[number % 6] + bytes([1, number]), sequence="annex"), 201)
    kept: dict[str, dict[str, str]] = {}  # by client: the digest-bearing state of the places that it wrote last
    jobs: list[dict[str, Any]] = []
    crowd = Crowd(busy, seed)

    def writer(client: httpx.Client, drawn: random.Random) -> None:
        """Owns some ids, of which some are those that a merge would bring."""
        own = kept.setdefault(threading.current_thread().name, {})
        name = threading.current_thread().name.rsplit("-", 1)[1].split(" ")[0]
        place = f"w{name}.{drawn.randrange(12)}"
        if own.get(place) and drawn.random() < 0.25:
            expect(client.delete(f"/v1/maps/hub/places/{place}"), 204)
            del own[place]
        else:
            mark = str(drawn.randrange(1 << 30))
            frame = FRAMES[drawn.randrange(6)] + bytes([2, drawn.randrange(256), drawn.randrange(256)])
            metadata = f'{{"mark": "{mark}"}}'
            expect(put(client, "hub", place, frame, metadata=metadata, sequence=f"w{name}"), 200, 201)
            own[place] = mark

    def merger(client: httpx.Client, drawn: random.Random) -> None:
        body = {"from": "annex", "dry_run": False, "on_conflict": "skip", "sample": 0}
        response = client.post("/v1/maps/hub/merge", json=body)
        if response.status_code == 202:
            jobs.append(response.json())
            if drawn.random() < 0.3:
                client.post(f"/v1/jobs/{jobs[-1]['id']}/cancel")
            client.get(f"/v1/jobs/{jobs[-1]['id']}?wait=5")
        else:
            expect(response, 503)
        for number in drawn.sample(range(40), 10):
            expect(client.delete(f"/v1/maps/hub/places/a{number}"), 204, 404)

    def loop_closer(client: httpx.Client, drawn: random.Random) -> None:
        frame = FRAMES[drawn.randrange(6)] + bytes([3, drawn.randrange(3)])
        params = {"id": f"c{drawn.randrange(10**9)}"}
        header = {"Content-Type": "image/jpeg"}
        expect(
            client.post("/v1/maps/hub/query:enrol", params=params, content=frame, headers=header), 200, 201, 409, 422
        )

    def bulk(client: httpx.Client, drawn: random.Random) -> None:
        name = f"b{drawn.randrange(10**6)}-"
        response = client.post("/v1/maps/hub/places?background=true", **traverse(8, name))
        jobs.append(expect(response, 202) | {"bulk": name})
        client.get(f"/v1/jobs/{jobs[-1]['id']}?wait=5")

    for work in (writer, writer, merger, loop_closer, bulk):
        crowd.add(work)
    crowd.go()
    ended = [(job, finished(busy, job)) for job in jobs]
    found = check_whole(busy, "hub")
    for own in kept.values():
        for place, mark in own.items():
            assert found[place]["metadata"] == {"mark": mark}, f"seed {seed}: {place} is not what was written last"
    mine = {place for own in kept.values() for place in own}
    assert {place for place in found if place.startswith("w")} == mine, f"seed {seed}: a deleted place is back"
    for asked, job in ended:
        assert job["state"] in ("succeeded", "cancelled") or job["problem"]["status"] < 500, job
        if "bulk" in asked:
            assert job["result"]["changes"] == {"created": 8}
            assert [place for place in found if place.startswith(asked["bulk"])] == [
                f"{asked['bulk']}{number}" for number in range(8)
            ]


@pytest.mark.thorough
def test_maps_that_are_deleted_and_created_again(busy: Server) -> None:
    """What was meant for a map that is gone never comes into the one that has its id now."""
    seed = 4711
    busy.create_map("stable", encoder=COARSE)
    for number in range(30):
        expect(busy.enrol("stable", f"s{number}", FRAMES[number % 6] + bytes([4, number]), x=number, y=0), 201)
    jobs: list[dict[str, Any]] = []
    lives: list[str] = []  # names of the lives of the map "phoenix", in their order
    crowd = Crowd(busy, seed)

    def owner(client: httpx.Client, drawn: random.Random) -> None:
        """Makes the map, lets others work on it, and deletes it."""
        if lives:
            expect(client.delete("/v1/maps/phoenix"), 204)
        expect(
            client.post("/v1/maps", json={"id": "phoenix", "encoder": COARSE, "description": f"life {len(lives)}"}), 201
        )
        lives.append(f"life {len(lives)}")
        expect(put(client, "phoenix", "mark", FRAMES[0], metadata=f'{{"life": "{lives[-1]}"}}'), 201)
        time.sleep(drawn.uniform(0.1, 0.5))

    def asker(client: httpx.Client, drawn: random.Random) -> None:
        kind = drawn.choice(["bulk", "merge", "prune", "calibrate", "rebuild", "verify"])
        address = "/v1/maps/phoenix"
        life = client.get(address)
        if life.status_code != 200:
            return
        if kind == "bulk":
            response = client.post(
                f"{address}/places?background=true", **traverse(20, f"{life.json()['description'].replace(' ', '')}.")
            )
        elif kind == "merge":
            body = {"from": "stable", "dry_run": False, "on_conflict": "skip", "sample": 0}
            response = client.post(f"{address}/merge", json=body)
        elif kind == "prune":
            response = client.post(f"{address}/prune", json={"dry_run": False, "similarity": 0.99})
        elif kind == "calibrate":
            response = client.post(f"{address}/calibrate", json={"method": "map", "background": True})
        else:
            response = client.post(f"{address}/{kind}" + ("?background=true" if kind == "verify" else ""))
        expect(response, 202, 404, 503)
        if response.status_code == 202:
            jobs.append(response.json())

    def robot(client: httpx.Client, drawn: random.Random) -> None:
        header = {"Content-Type": "image/jpeg"}
        expect(client.post("/v1/maps/phoenix/query", content=FRAMES[drawn.randrange(6)], headers=header), 200, 404)

    for work in (owner, asker, asker, robot):
        crowd.add(work)
    crowd.go()
    for job in jobs:
        ended = finished(busy, job)
        assert ended["state"] == "succeeded" or ended["problem"]["status"] < 500, ended
    found = check_whole(busy, "phoenix")
    assert found["mark"]["metadata"] == {"life": lives[-1]} if "mark" in found else True, f"seed {seed}"
    # What came by a job was asked for when this map was there already.
    born = busy.client.get("/v1/maps/phoenix").json()["created_at"]
    asked_later = {job["kind"] for job in jobs if job["created_at"] >= born}
    assert "merge" in asked_later or not [place for place in found if place.startswith("s")], f"seed {seed}"
    assert "enrol" in asked_later or not [place for place in found if place.startswith("life")], f"seed {seed}"
    assert len(check_whole(busy, "stable")) == 30
    assert not any((busy.data_dir / "staging").iterdir())
    assert not list(Path(busy.data_dir).glob("maps/.*")), "no map is left half made"
