"""Imports whose task is cancelled, as the server does when it stops."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from core.disk.files import write_at
from core.ledger.maps import places
from core.maps import MapSettings
from core.maps.archives import unpacking
from service.app.runtime import Runtime
from service.errors.faults import TooManyImports
from service.maps import imports
from service.maps.imports import ReceivedFile
from tests.core.store.archives.files import exported
from tests.service.engines import ENCODER, enrolments, runtime_at


@pytest.fixture
def content(tmp_path: Path) -> bytes:
    with runtime_at(tmp_path / "source") as runtime:
        lab = runtime.engine.maps.create("lab", ENCODER, 8, MapSettings(keep="none"))
        lab.enrol(enrolments(1, 3, "p", "monday"))
        return exported(lab, tmp_path / "kept")


async def chunks(data: bytes) -> AsyncIterator[bytes]:
    yield data


async def received(runtime: Runtime, data: bytes) -> ReceivedFile:
    return await runtime.imports.receive(chunks(data), 0, lambda _: "lab")


class Gate:
    """A function whose calls wait until the gate is opened."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self.reached, self.opened = threading.Event(), threading.Event()

    def __call__(self, *arguments: Any) -> Any:
        self.reached.set()
        assert self.opened.wait(60)
        return self._function(*arguments)

    async def cancelled_there(self, task: asyncio.Task[Any]) -> None:
        """Cancel a task whose thread waits at the gate, and check that the task waits, too."""
        async with asyncio.timeout(10):
            while not self.reached.is_set():
                await asyncio.sleep(0.001)
        task.cancel()
        await asyncio.sleep(0.01)
        assert not task.done()

    async def open(self, task: asyncio.Task[Any]) -> None:
        self.opened.set()
        with pytest.raises(asyncio.CancelledError):
            await task


@pytest.mark.anyio
async def test_cancelled_while_the_file_arrives(
    tmp_path: Path, content: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    with runtime_at(tmp_path) as runtime:
        gate = Gate(write_at)
        monkeypatch.setattr(imports, "write_at", gate)
        task = asyncio.create_task(received(runtime, content))
        await gate.cancelled_there(task)
        with (tmp_path / "another").open(
            "xb"
        ) as another:  # it would get the descriptor of a file that was closed too early
            await gate.open(task)
            assert another.tell() == 0
        assert (tmp_path / "another").read_bytes() == b""
        assert list((tmp_path / "data" / "imports").iterdir()) == []
        monkeypatch.undo()
        first, second = await received(runtime, content), await received(runtime, content)
        with pytest.raises(TooManyImports):
            await received(runtime, content)
        assert len({first.name, second.name}) == 2
    with runtime_at(tmp_path) as runtime:
        runtime.imports.clean()
        assert list((tmp_path / "data" / "imports").iterdir()) == []
        await received(runtime, content)


@pytest.mark.anyio
async def test_cancelled_while_the_map_is_built(
    tmp_path: Path, content: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    with runtime_at(tmp_path) as runtime:
        # The encoder of the test maps does not exist, so that nothing is known of the length of its descriptors.
        monkeypatch.setattr(runtime.imports, "check_encoder", lambda _: SimpleNamespace(definition=None))
        monkeypatch.setattr(unpacking, "CHUNK_BYTES", 1)
        gate = Gate(places.rows_of)
        with monkeypatch.context() as patched:
            patched.setattr(places, "rows_of", gate)
            task = asyncio.create_task(runtime.imports.build(await received(runtime, content)))
            await gate.cancelled_there(task)
            await gate.open(task)
        assert list((tmp_path / "data" / "imports").iterdir()) == []
        assert list((tmp_path / "data" / "maps").iterdir()) == [], "it stopped after the first of three commits"
        arrived = await received(runtime, content)
        await runtime.imports.build(arrived)
        assert runtime.engine.maps.get("lab").count_places() == 3
