"""Every operation of ``openapi.json`` has a call, in both halves, and the service's whole answer arrives."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from placerec_client import AsyncClient, Client, Map, NewPlace, Problem, models, problems
from placerec_client.model import Model
from service.access.keys import Keys
from tests.clients.python.models import operations
from tests.core.recordings.bags import walk, write_mcap
from tests.service.scenes import encoded, jpeg, scene, seen_again, stranger
from tests.service.server import Server

EVERY = {
    (method, re.compile(re.sub(r"\{\w+\}", "[^/]+", path)))
    for method, path, _ in operations()
    if "/stretches/" not in path  # tests/service/learning/test_new_ground.py, which drives a robot off a map, has these
}


class Recording(httpx.HTTPTransport):
    """The way to the service, which notes what was asked and how it was answered."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[str, str, int]] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        response = super().handle_request(request)
        self.seen.append((request.method, request.url.path, response.status_code))
        return response


class AsyncRecording(httpx.AsyncHTTPTransport):
    """The same for the asynchronous half."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[str, str, int]] = []

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        response = await super().handle_async_request(request)
        self.seen.append((request.method, request.url.path, response.status_code))
        return response


def assert_every_operation(seen: list[tuple[str, str, int]]) -> None:
    done = {(method, path) for method, path, status in seen if 200 <= status < 300}
    missing = [
        f"{method} {path.pattern}"
        for method, path in EVERY
        if not any(method == one and path.fullmatch(other) for one, other in done)
    ]
    assert missing == []


def assert_whole(answer: Model, sent: Any) -> None:
    """No field of what was sent is missing from the model."""
    known = answer.model_dump()
    for name, value in sent.items():
        assert name in known, f"{type(answer).__name__} has no {name}"
        part = getattr(answer, name)
        if isinstance(part, Model) and isinstance(value, dict):
            assert_whole(part, value)
        if isinstance(part, list) and part and isinstance(part[0], Model):
            for one, other in zip(part, value, strict=True):
                assert_whole(one, other)


LABELS: list[Any] = [{"file": f"f{n}", "place": f"p{n % 8}" if n < 16 else None} for n in range(32)]


TARGET: Any = {"rule": "precision", "value": 0.8}


def calibration_frames() -> dict[str, bytes]:
    """Sixteen frames of the first eight scenes, and as many of places that no map has."""
    return {f"f{n}": encoded(seen_again(scene(n % 8), n) if n < 16 else stranger(n + 20)) for n in range(32)}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """The address and an administrator's key of a service that has keys."""
    folder = tmp_path_factory.mktemp("guarded")
    (folder / "data").mkdir()
    _, key = Keys.of(folder / "data").create("ann", "admin")
    running = Server(folder, {"backup_dir": folder / "backups"}, key=key).wait()
    yield str(running.client.base_url), key
    assert running.stop() == 0


@pytest.mark.thorough
def test_every_operation_has_a_call(guarded: tuple[str, str], tmp_path: Path) -> None:
    recording = Recording()
    url, key = guarded
    with Client(url, key=key, transport=recording) as client:
        tour(client, tmp_path)
    assert_every_operation(recording.seen)


def the_service(client: Client) -> None:
    assert client.liveness().status == "ok" and client.readiness().status == "ready"
    assert client.version().name == "placerec" and "placerec_" in client.metrics()
    assert any(encoder.default for encoder in client.encoders)
    assert client.own_key().role == "admin" and client.state().version
    assert client.fleet().robots == [] and client.history(1).step_seconds == 60
    made = client.keys.create("robot-7", "enrol", maps=["tour"])
    assert made.key.startswith("placerec_") and client.keys.read(made.id).name == "robot-7"
    assert client.keys.narrow(made.id, {"role": "query"}).role == "query"
    assert client.keys.delete(made.id).state == "revoked"
    assert made.id in [key.id for key in client.keys]
    assert client.backups.schedule(None, keep=3).next_at is None
    saved = client.backups.create().wait().result
    assert saved and client.backups.list().items[0].id == saved["backup"]
    assert "create_key" in [entry.operation for entry in client.audit()]


def a_bag(lab: Map, folder: Path) -> None:
    bag = write_mcap(folder / "walk.mcap", walk())
    name = lab.recordings.upload(bag)
    assert lab.recordings.size(name) == bag.stat().st_size
    lab.recordings.delete(name)
    job = lab.recordings.enrol(lab.recordings.upload(bag), sequence="bag", keep_standing=True)
    assert job.wait().state == "succeeded" and lab.sequences.delete("bag").places == 6


def tour(client: Client, folder: Path) -> None:
    the_service(client)
    review: Any = {"verdicts": ["recognized", "ambiguous", "unknown"], "most_frames": 20}
    lab = client.maps.create("tour", keep="image", description="a map", review=review)
    assert lab.view and lab.view.keep == "image"
    assert lab.cameras.put("front", mask={"polygons": [[(0, 0.9), (1, 0.9), (1, 1)]]}).name == "front"
    assert lab.cameras.read("front").mask and [one.name for one in lab.cameras] == ["front"]
    for number in range(12):
        frame: Any = scene(number) if number else jpeg(0)
        place = lab.places.put(f"p{number}", frame, x=2 * number, y=0.0, sequence="monday", metadata={"floor": number})
        assert (place.change, place.sequence, place.metadata) == ("created", "monday", {"floor": number})
    assert {one.change for one in lab.enrol(NewPlace(f"q{n}", jpeg(30 + n)) for n in range(3))} == {"created"}
    assert [one.id for one in lab.places.list(sequence="monday")] == [f"p{number}" for number in range(12)]
    assert lab.places.read("p1").pose == models.Pose(x=2, y=0)
    assert lab.places.edit("p1", {"pose": {"heading": 90}}).pose == models.Pose(x=2, y=0, heading=90)
    assert lab.places.thumbnail("p1").startswith(b"\xff\xd8")
    lab.places.delete("q2")
    assert lab.places.delete_many(ids=["q1", "q9"], dry_run=False).missing == ["q9"]
    compared = lab.places.compare([{"id": "p1"}, {"id": "new"}], sequence="monday", named=False)
    assert [one.id for one in compared.taken] == ["p1"] and compared.free == "monday~2"
    (kept,) = lab.enrol([NewPlace("p1", jpeg(77))], replace=False)
    assert isinstance(kept.error, problems.PlacesTaken)
    plan = lab.plan()
    assert len(plan.ids) == plan.places == 13
    covered = lab.coverage(x=2.5, y=0.0, k=2)
    assert covered.state == "covered" and [one.place for one in covered.nearest] == ["p1", "p2"]
    answer = lab.query(jpeg(3), k=2, explain=True, where={"floor": 3}, camera="front")
    assert answer.verdict == "recognized" and answer.place and answer.place.id == "p3"
    assert answer.explanation and answer.explanation.picture
    assert lab.explanation(answer.explanation.picture).startswith(b"\x89PNG")
    found = list(lab.query_batch([jpeg(2), jpeg(4)], sequences=["monday"]))
    assert [one.answer and one.answer.place and one.answer.place.id for one in found] == ["p2", "p4"]
    events = iter(lab.events(kinds=["query"], verdicts="recognized"))
    assert next(events).kind == "listening"
    lab.query(jpeg(4))
    assert next(events).data["best"] == "p4"
    closure = lab.query_or_enrol("loop", jpeg(60), sequence="tuesday")
    assert closure.enrolment == "created" and closure.enrolled and closure.enrolled.id == "loop"
    assert client.query({"left": jpeg(1), "right": scene(1)}, maps=["tour"]).map == "tour"
    several = client.query(jpeg(5), maps="tour")
    assert several.place and several.place.id == "p5"
    assert len(client.encode(jpeg(1)).descriptor) > 100 and client.regions(jpeg(1)).regions
    assert client.draw_regions(jpeg(1)).startswith(b"\x89PNG")
    assert client.match(jpeg(1), scene(1)).score > 0.5 and client.draw_match(jpeg(1), jpeg(2)).startswith(b"\x89PNG")
    session(lab)
    labelling(lab)
    looks(lab)
    assert lab.answers(limit=5).items and lab.places.matches("p3").items
    assert lab.calibration(threshold=0.5).map == "tour"
    report = lab.calibrate("frames", frames=calibration_frames(), labels=LABELS, target=TARGET, dry_run=True)
    assert not report.stored and report.measurement.frames == 32
    assert lab.verify().ok and lab.verify(background=True).wait().state == "succeeded"
    assert lab.health(limit=5).map == "tour"
    edited = lab.edit({"description": "edited"}, if_match=lab.read().revision)
    with pytest.raises(problems.RevisionMismatch):
        lab.edit({"description": "again"}, if_match=edited.revision - 1)
    jobs(client, folder)
    assert [one.name for one in lab.sequences] == ["monday", "tuesday"]
    assert lab.sequences.delete("tuesday").places == 1
    a_bag(lab, folder)
    lab.cameras.delete("front")
    for name in [one.id for one in client.maps if one.id.startswith("tour")]:
        client.maps[name].delete()


def labelling(lab: Any) -> None:
    until = time.monotonic() + 60
    while not (kept := list(lab.review)) and time.monotonic() < until:  # frames are kept behind the answers
        time.sleep(0.05)
    assert lab.review.picture(kept[0].id)[:2] in (b"\xff\xd8", b"\x89P")
    assert lab.review.label(kept[0].id, place="p3").frame is not None
    assert [one.place for one in lab.review.labels()] == ["p3"]
    assert lab.review.label(kept[0].id, discard=True).discarded
    assert list(lab.review.stretches()) == []
    for refused in (lab.review.accept_stretch, lab.review.reject_stretch):
        with pytest.raises(problems.UnknownStretch):
            refused("s-0-1")


def looks(lab: Any) -> None:
    added = lab.places.add_look("p4", jpeg(71), timestamp="2026-11-20T22:00:00Z")
    assert (added.change, added.place, added.run) == ("created", "p4", None)
    assert [one.name for one in lab.places.looks("p4")] == [one.name for one in lab.places.all_looks()] == [added.name]
    assert lab.places.look_thumbnail("p4", added.name).startswith(b"\xff\xd8")
    assert lab.places.delete_learnt_looks(run="no run").looks == 0
    assert lab.places.delete_learnt_looks(until=datetime(2020, 1, 1, tzinfo=UTC)).looks == 0
    lab.places.delete_look("p4", added.name)
    assert list(lab.places.looks("p4")) == []


def session(lab: Any) -> None:
    with lab.sessions.begin(advance=1) as one:
        first = one.send(jpeg(0))
        assert (first.frame, one.send(jpeg(1), forward=2.0).frame) == (0, 1)
        assert one.read().frames == 2 and one.id in [other.id for other in lab.sessions]
        assert lab.sessions[one.id].send(jpeg(2)).frame == 2
    with pytest.raises(Problem):
        one.read()


def jobs(client: Client, folder: Path) -> None:
    lab = client.maps["tour"]
    told: list[models.JobView] = []
    assert lab.keypoints().wait(told.append).state == "succeeded" and told[-1].state == "succeeded"
    assert [job.state for job in lab.rebuild().events()][-1] == "succeeded"
    sent = lab.enrol_by_job([NewPlace(f"t{n}", jpeg(n), {"sequence": "tuesday"}) for n in range(12)], align=True)
    result = sent.wait().result
    assert result and result["changes"] == {"created": 12}
    assert lab.compare("tuesday", "monday").columns == 12
    assert lab.draw_comparison("tuesday", "monday").startswith(b"\x89PNG")
    assert lab.align("tuesday", dry_run=True).wait().result
    assert lab.erase(ids=["nowhere"]).wait().state == "succeeded"
    assert lab.prune(max_recall_loss=0.1).wait().state == "succeeded"
    assert lab.reencode("tour-2").wait().state == "succeeded"
    assert client.maps["tour-2"].merge("tour", on_conflict="skip").wait().state == "succeeded"
    lab.sequences.delete("tuesday")
    lab.query_or_enrol("again", stranger(70), sequence="tuesday")
    tag = lab.export(folder / "tour.tar")
    assert tag and lab.export(folder / "tour.tar", overwrite=True, known=tag) is None
    assert client.maps.import_(folder / "tour.tar", id="tour-3").wait().state == "succeeded"
    first = lab.verify(background=True)
    for _ in range(100):
        with suppress(problems.JobEnded):  # it was done before it could be cancelled
            assert lab.verify(background=True).cancel().state in ("cancelled", "running")
            break
    first.wait()
    assert client.jobs[first.id].read().kind == "verify"
    assert first.id in [job.id for job in client.jobs.list(map="tour", kind="verify")]


@pytest.mark.thorough
def test_every_call_is_there_asynchronously(guarded: tuple[str, str], tmp_path: Path) -> None:
    """The halves have the same names, so the same tour goes through both: each await is done for it."""
    recording = AsyncRecording()

    async def work() -> None:
        async with AsyncClient(guarded[0], key=guarded[1], transport=recording) as client:
            loop = asyncio.get_running_loop()
            stand_in = Awaited(client, loop)
            await asyncio.to_thread(tour, stand_in, tmp_path)  # type: ignore[arg-type]

    asyncio.run(work())
    assert_every_operation(recording.seen)


class Awaited:
    """An object of the asynchronous half, used from another thread as one of the synchronous half."""

    def __init__(self, of: Any, loop: asyncio.AbstractEventLoop) -> None:
        self._of, self._loop = of, loop

    def __getattr__(self, name: str) -> Any:
        return self._given(getattr(self._of, name))

    def __getitem__(self, key: str) -> Any:
        return self._given(self._of[key])

    def __iter__(self) -> Iterator[Any]:
        return self._items(self._of.__aiter__())

    def __enter__(self) -> Any:
        return self._given(self._wait(self._of.__aenter__()))

    def __exit__(self, *error: object) -> None:
        self._wait(self._of.__aexit__(*error))

    def _given(self, found: Any) -> Any:
        if callable(found):
            return lambda *given, **named: self._given(found(*given, **named))
        if asyncio.iscoroutine(found):
            return self._given(self._wait(found))
        if isinstance(found, AsyncIterator):
            return self._items(found)
        ours = type(found).__module__.startswith("placerec_client._async")
        return Awaited(found, self._loop) if ours else found

    def _wait(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(60)

    def _items(self, items: AsyncIterator[Any]) -> Iterator[Any]:
        async def following() -> Any:
            return await anext(items, StopIteration)

        while (item := self._wait(following())) is not StopIteration:
            yield item


def test_the_whole_answer_arrives(guarded: tuple[str, str]) -> None:
    with Client(guarded[0], key=guarded[1]) as client:
        compare(client, client.maps.create("whole"))


def compare(client: Client, lab: Map) -> None:
    for number in range(3):
        lab.places.put(f"p{number}", scene(number), x=number, y=0, heading=np.float64(1.5))
    asked = client.connection
    options = {"verify": "always", "explain": True}
    sent = asked.request("POST", f"{lab.path}/query", params=options, content=jpeg(1), media_type="image/jpeg")
    assert_whole(models.QueryAnswer.model_validate_json(sent.content), sent.json())
    for path, model in ((lab.path, models.MapView), ("/v1/encoders", models.EncoderPage), ("/version", models.Version)):
        read = asked.request("GET", path)
        assert_whole(model.model_validate_json(read.content), read.json())
