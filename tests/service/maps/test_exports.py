"""Exports that are kept: how many, for how long, in how much room; and what a download of one is answered."""

from __future__ import annotations

import asyncio
import shutil
import threading
from collections import namedtuple
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from starlette.types import Message

from core.errors import StorageFull
from core.maps import MapSettings
from core.maps.archives.writing import Advance, Expect, Exported
from core.store import Directory, Map
from service.errors.faults import RangeNotSatisfiable, TooManyExports
from service.maps.exports import FOLDER, Export, ExportResponse, Exports
from service.places.staging import RESERVE
from service.settings import Settings
from tests.service.engines import ENCODER, enrolments

Usage = namedtuple("Usage", "total used free")


@dataclass
class Place:
    """Three maps, and exports of them of which at most two are kept."""

    exports: Exports
    maps: dict[str, Map]
    folder: Path

    @property
    def files(self) -> set[Path]:
        return set(self.folder.glob("*"))

    async def settled(self, kept: set[Path]) -> None:
        """Wait until these files are left."""
        while self.files != kept:
            await asyncio.sleep(0.01)

    async def sent(self, export: Export, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body of a download."""
        messages: list[Message] = []

        async def send(message: Message) -> None:
            messages.append(message)

        async def receive() -> Message:
            await asyncio.sleep(60)
            return {"type": "http.disconnect"}

        given = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
        scope = {"type": "http", "method": "GET", "headers": given, "state": {"method": method}}
        response = ExportResponse(self.exports, export, {"ETag": f'"{export.file.tag}"'})
        assert export.readers == 1
        try:
            await response(scope, receive, send)
        finally:
            assert export.readers == 0
        start, *bodies = messages
        answered = {name.decode(): value.decode() for name, value in start["headers"]}
        return start["status"], answered, b"".join(one.get("body", b"") for one in bodies)


Work = Callable[[Place], Coroutine[Any, Any, None]]
Run = Callable[[Work], None]


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    """Runs a test on an event loop."""
    settings = Settings(data_dir=tmp_path / "data", max_exports=2)
    atlas, maps = Directory(settings.data_dir), {}
    for name in ("a", "b", "c"):
        maps[name] = atlas.create(name, ENCODER, 8, MapSettings(keep="none"))
        maps[name].enrol(enrolments(1, 3, "p", "monday"))

    async def to_the_end(work: Work) -> None:
        place = Place(Exports(settings), maps, settings.data_dir / FOLDER)
        async with asyncio.timeout(60):
            await work(place)
            await place.exports.close()
        assert not place.folder.exists()

    yield lambda work: asyncio.run(to_the_end(work))
    atlas.close()


@pytest.mark.parametrize(
    ("header", "start", "stop"),
    [
        ("bytes=0-", 0, None), ("bytes=0-0", 0, 1), ("bytes=10-19", 10, 20), ("bytes=-10", -10, None),
        ("bytes=90-99999999", 90, None), ("BYTES=5-6", 5, 7), ("bytes=-99999999", 0, None),
    ],
)  # fmt: skip
def test_a_range(run: Run, header: str, start: int, stop: int | None) -> None:
    async def work(place: Place) -> None:
        export = await place.exports.create(place.maps["a"])
        whole = export.file.path.read_bytes()
        status, headers, body = await place.sent(export, range=header)
        assert status == 206 and body == whole[start:stop]
        first = start % len(whole)
        assert headers["content-range"] == f"bytes {first}-{first + len(body) - 1}/{len(whole)}"
        assert int(headers["content-length"]) == len(body)

    run(work)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("method", "headers"),
    [
        ("GET", {}),
        ("HEAD", {}),
        ("HEAD", {"range": "bytes=5-"}),
        ("HEAD", {"range": "bytes=99999999-"}),
        ("GET", {"range": "bytes=5-", "if_range": '"another"'}),
        ("GET", {"range": "bytes=5-", "if_range": "its date"}),
        *(("GET", {"range": given}) for given in ("", "bytes=", "bytes=-", "bytes=5-4", "lines=1-2", "bytes=a-b", "x")),
        ("GET", {"range": "bytes=" + "9" * 5000 + "-"}),
    ],
)
def test_what_names_no_range_of_this_file_is_answered_with_all_of_it(
    run: Run, method: str, headers: dict[str, str]
) -> None:
    async def work(place: Place) -> None:
        export = await place.exports.create(place.maps["a"])
        whole = export.file.path.read_bytes()
        if headers.get("if_range") == "its date":  # a map may change twice within its second
            headers["if_range"] = (await place.sent(export))[1]["last-modified"]
        status, answered, body = await place.sent(export, method, **headers)
        assert (status, body) == (200, whole if method == "GET" else b"")
        assert answered["content-length"] == str(len(whole)) and answered["accept-ranges"] == "bytes"
        assert answered["etag"] == f'"{export.file.tag}"'

    run(work)


@pytest.mark.parametrize("header", ["bytes=99999999-", "bytes=-0", "bytes=99999999-99999999"])
def test_a_range_behind_the_end(run: Run, header: str) -> None:
    async def work(place: Place) -> None:
        export = await place.exports.create(place.maps["a"])
        with pytest.raises(RangeNotSatisfiable) as refused:
            await place.sent(export, range=header)
        assert refused.value.headers == {"Content-Range": f"bytes */{export.file.size}"}
        assert export.readers == 0

    run(work)


def test_several_ranges_come_in_parts(run: Run) -> None:
    async def work(place: Place) -> None:
        export = await place.exports.create(place.maps["a"])
        whole = export.file.path.read_bytes()
        status, headers, body = await place.sent(export, range="bytes=0-99, 600-699", if_range=f'"{export.file.tag}"')
        assert status == 206 and headers["content-type"].startswith("multipart/byteranges")
        assert whole[:100] in body and whole[600:700] in body

    run(work)


def test_a_map_that_has_not_changed_is_written_once(run: Run) -> None:
    async def work(place: Place) -> None:
        a = place.maps["a"]
        assert await place.exports.tag_of(a) is None
        first, second = await asyncio.gather(place.exports.create(a), place.exports.create(a))
        assert first is second and await place.exports.create(a) is first
        assert place.files == {first.file.path} and await place.exports.tag_of(a) == first.file.tag
        a.enrol(enrolments(7, 1, "later", "monday"))
        assert await place.exports.tag_of(a) is None
        other = await place.exports.create(a)
        assert other is not first and place.exports.find("a", [first.file.tag]) is first
        # What is known of a map outlasts its file.
        for name in ("b", "c"):
            await place.exports.create(place.maps[name])
        assert place.exports.find("a", [other.file.tag]) is None
        assert await place.exports.tag_of(a) == other.file.tag

    run(work)


def test_what_was_acknowledged_before_a_download_began_is_in_it(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another download of the same map is being written then, and does not have it."""

    async def work(place: Place) -> None:
        a, begun, free = place.maps["a"], threading.Event(), threading.Event()
        write = a.exporter.write

        def slow(path: Path, advance: Advance, expect: Expect) -> Exported:
            def waiting(written: int) -> None:
                begun.set()
                assert free.wait(60)
                advance(written)

            return write(path, waiting, expect)

        monkeypatch.setattr(a.exporter, "write", slow)
        first = asyncio.create_task(place.exports.create(a))
        assert await asyncio.to_thread(begun.wait, 30)
        a.enrol(enrolments(7, 1, "later", "monday"))
        others = [asyncio.create_task(place.exports.create(a)) for _ in range(2)]
        await asyncio.sleep(0)
        free.set()
        assert (await first).file.manifest.places == 3
        later, same = await asyncio.gather(*others)
        assert later is same and later.file.manifest.places == 4

    run(work)


def test_one_that_was_removed_before_it_was_read_is_written_again(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(place: Place) -> None:
        create, made = place.exports._create, list[Export]()

        async def removed_at_once(map_: Map) -> Export:
            made.append(export := await create(map_))
            if len(made) == 1:
                await place.exports._remove(export)
            return export

        monkeypatch.setattr(place.exports, "_create", removed_at_once)
        export = await place.exports.create(place.maps["a"])
        assert export is made[1] and export.file.path.exists()
        place.exports._expire(made[0])  # whose id and tag are those of the second
        assert place.exports.find("a", [export.file.tag]) is export

    run(work)


def test_the_one_that_was_not_read_for_longest_makes_room(run: Run) -> None:
    async def work(place: Place) -> None:
        made = [await place.exports.create(place.maps[name]) for name in ("a", "b", "c")]
        await place.settled({export.file.path for export in made[1:]})
        releases = [place.exports.hold(export) for export in made[1:]]
        with pytest.raises(TooManyExports):
            await place.exports.create(place.maps["a"])
        for release in releases:
            release(False)
        await place.exports.create(place.maps["a"])
        await place.settled(place.files - {made[1].file.path})
        assert made[2].file.path in place.files

    run(work)


def test_a_full_disk_costs_idle_exports_first(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(place: Place) -> None:
        monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(1 << 41, 0, RESERVE + 1 if place.files else 1 << 40))
        first = await place.exports.create(place.maps["a"])
        release = place.exports.hold(first)
        with pytest.raises(StorageFull, match="no room for the map as a file"):
            await place.exports.create(place.maps["b"])
        assert place.files == {first.file.path}
        release(False)
        second = await place.exports.create(place.maps["b"])
        assert place.files == {second.file.path}

    run(work)


def test_exports_that_cannot_make_enough_room_stay(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(place: Place) -> None:
        first = await place.exports.create(place.maps["a"])
        monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(1 << 41, 0, RESERVE - 1))
        place.maps["b"].enrol(enrolments(7, 40, "more", "monday"))
        with pytest.raises(StorageFull, match="no room for the map as a file"):
            await place.exports.create(place.maps["b"])
        assert place.files == {first.file.path}

    run(work)


def test_it_goes_when_it_was_not_used_for_its_time(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(place: Place) -> None:
        export = await place.exports.create(place.maps["a"])
        release = place.exports.hold(export)
        monkeypatch.setattr(place.exports, "_seconds", 0.01)
        place.exports._expire(export)
        assert place.exports.find("a", [export.file.tag]) is export, "it is being read"
        release(False)
        await place.settled(set())

    run(work)


@pytest.mark.parametrize(
    ("headers", "seconds"),
    [({}, 300), ({"range": "bytes=-1"}, 300), ({"range": "bytes=0-99"}, 3600), ({"range": "bytes=0-9, 50-59"}, 3600)],
)
def test_it_goes_sooner_when_its_last_byte_was_sent(run: Run, headers: dict[str, str], seconds: float) -> None:
    async def work(place: Place) -> None:
        export = await place.exports.create(place.maps["a"])
        await place.sent(export, **headers)
        assert export.expiry is not None
        left = export.expiry.when() - asyncio.get_running_loop().time()
        assert seconds - 60 < left <= seconds
        await place.sent(export, "HEAD")
        assert export.expiry.when() - asyncio.get_running_loop().time() > 3540, "somebody asks for it again"

    run(work)


def test_what_a_crash_left_is_removed(run: Run) -> None:
    async def work(place: Place) -> None:
        place.folder.mkdir()
        (place.folder / "0123.tar").write_bytes(b"half of a file")
        place.exports.clean()
        assert not place.folder.exists()

    run(work)
