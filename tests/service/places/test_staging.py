"""Forms on disk: they arrive completely, are cut, refused or damaged, and are removed at a start."""

from __future__ import annotations

import asyncio
import os
import shutil
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from core.disk.files import write_at
from core.errors import StorageFailure, StorageFull
from service.errors.faults import BodyTooLarge, ClientGone, MalformedBody, StagingFull
from service.fairness import CALLER
from service.places import staging as module
from service.places.staging import Staging

TYPE = "multipart/form-data; boundary=b"


def body(**parts: bytes) -> bytes:
    head = b'--b\r\nContent-Disposition: form-data; name="%s"; filename="x"\r\n\r\n%s\r\n'
    return b"".join(head % (name.encode(), data) for name, data in parts.items()) + b"--b--\r\n"


async def chunks(data: bytes, size: int = 1000, gone: bool = False) -> AsyncIterator[bytes]:
    for start in range(0, len(data), size):
        yield data[start : start + size]
    if gone:
        raise ClientGone("The connection was closed.")


async def received(staging: Staging, data: bytes, gone: bool = False, announced: int = 0) -> str:
    return await staging.receive(chunks(data, gone=gone), TYPE, announced, 4, 5000)


def left(folder: Path) -> list[str]:
    return [path.name for path in (folder / "staging").iterdir()]


@pytest.mark.anyio
async def test_parts_come_back_as_they_were_sent(tmp_path: Path) -> None:
    staging, random = Staging(tmp_path, 1 << 20), os.urandom(4321)
    name = await received(staging, body(one=random, big=bytes(5001), empty=b"", two=b"2"))
    assert left(tmp_path) == [name]
    form = Staging(tmp_path, 1 << 20).open(name)  # as after a restart
    found = {part.name: form.read(part) for part in form.parts}
    assert {name: part.data for name, part in found.items()} == {"one": random, "big": b"", "empty": b"", "two": b"2"}
    assert [name for name, part in found.items() if part.oversized] == ["big"]
    assert found["one"].filename == "x" and staging.size() == len(random) + 1
    staging.remove(name)
    staging.remove(name)
    assert left(tmp_path) == []


@pytest.mark.anyio
async def test_a_caller_with_less_than_its_share_is_let_in(tmp_path: Path) -> None:
    staging = Staging(tmp_path, 10, reserve=0)
    for _ in range(2):
        await received(staging, body(one=b"12345"))
    with pytest.raises(StagingFull):
        await received(staging, body(one=b"1"), announced=1)
    token = CALLER.set("robot")
    await received(staging, body(one=b"12345"), announced=5)
    with pytest.raises(StagingFull):
        await received(staging, body(one=b"1"), announced=1)
    CALLER.reset(token)


@pytest.mark.anyio
async def test_an_incomplete_form_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    staging = Staging(tmp_path, 1 << 20)
    with pytest.raises(MalformedBody):
        await received(staging, body(one=b"1")[:-4])
    with pytest.raises(ClientGone):
        await received(staging, body(one=b"1"), gone=True)
    with pytest.raises(BodyTooLarge):
        await received(staging, body(**{f"p{n}": b"1" for n in range(5)}))
    with pytest.raises(StagingFull):
        await received(staging, b"", announced=(1 << 20) + 1)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr("service.places.staging.write_at", full)
        with pytest.raises(StorageFull):
            await received(staging, body(one=b"1"))
    with monkeypatch.context() as disk:
        disk.setattr("os.fsync", full)
        with pytest.raises(StorageFull):
            await received(staging, body(one=b"1"))
    assert left(tmp_path) == []
    await received(staging, body(one=b"1"))


@pytest.mark.anyio
async def test_damage_is_found_and_a_start_removes_forms_without_a_job(tmp_path: Path) -> None:
    staging = Staging(tmp_path, 1 << 20)
    first, second = [await received(staging, body(one=b"first")) for _ in range(2)]
    (tmp_path / "staging" / ".arriving").mkdir()
    path = tmp_path / "staging" / first / "form"
    path.write_bytes(b"f1rst")
    form = staging.open(first)
    with pytest.raises(StorageFailure, match="damaged"):
        form.read(form.parts[0])
    (tmp_path / "staging" / first / "parts").write_bytes(b"[{}]")
    with pytest.raises(StorageFailure, match="damaged"):
        staging.open(first)
    with pytest.raises(StorageFailure):
        staging.open("none")
    staging.clean({second})
    assert left(tmp_path) == [second]
    restarted = Staging(tmp_path, 6)
    restarted.clean({second})
    assert restarted.size() == 5
    with pytest.raises(StagingFull):
        await received(restarted, body(one=b"1"), announced=2)
    restarted.remove(second)
    assert restarted.size() == 0
    await received(restarted, body(one=b"1"), announced=2)


@pytest.mark.anyio
async def test_a_cancelled_task_writes_into_no_other_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the server does when it stops; the thread goes on, and its file's number must not become another's."""
    staging, reached, opened = Staging(tmp_path, 1 << 20), threading.Event(), threading.Event()

    def late(*arguments: Any) -> None:
        reached.set()
        assert opened.wait(60)
        write_at(*arguments)

    monkeypatch.setattr(module, "write_at", late)
    task = asyncio.create_task(received(staging, body(one=b"1" * 900), announced=900))
    async with asyncio.timeout(10):
        while not reached.is_set():
            await asyncio.sleep(0.001)
    task.cancel()
    await asyncio.sleep(0.01)
    assert not task.done() and staging.size() == 900
    with (tmp_path / "another").open("xb"):
        opened.set()
        with pytest.raises(asyncio.CancelledError):
            await task
    assert (tmp_path / "another").read_bytes() == b""
    assert left(tmp_path) == [] and staging.size() == 0


@pytest.mark.anyio
async def test_forms_leave_room_for_the_maps(tmp_path: Path) -> None:
    free = shutil.disk_usage(tmp_path).free
    with pytest.raises(StorageFull, match="beside the maps"):
        await received(Staging(tmp_path, 2 * free, reserve=free + (1 << 30)), body(one=b"1"))
    roomy = Staging(tmp_path, 2 * free, reserve=0)
    with pytest.raises(StorageFull, match="no room for"):
        await received(roomy, body(one=b"1"), announced=free + (1 << 30))
    assert left(tmp_path) == [] and roomy.size() == 0
    await received(roomy, body(one=b"1"), announced=1000)
