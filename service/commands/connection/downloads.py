"""Map files between a service and a disk: in pieces that can be taken up again, and never believed unchecked."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx

from service.commands.connection.client import Refused, Service, path_of
from service.commands.console import Failure, progress

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from core.storage.archives.reading import Archive

PIECE_BYTES = 16 << 20
"""Of one request: what is in memory at one time, and what is lost when a connection breaks."""

PATIENCE = 600.0
"""Seconds for which a piece is asked for again while the service is overloaded, restarts or reads a large map."""

RESTARTS = 3
"""So often a download begins anew because the service does not keep the moment any more of which a part is here."""

PARTIAL = ".part"
MIB = 1 << 20


def check_file(path: Path, expected: str | None = None) -> Archive:
    """A file, all of whose parts have the SHA-256 that its manifest says; it is closed.

    Args:
        expected: what the manifest's SHA-256 has to be.

    Raises:
        Failure: it cannot be read, is damaged, or another file.
    """
    from core.errors import PlacerecError
    from core.storage.archives.reading import Archive, check

    try:
        with Archive(path) as archive:
            if expected is not None and archive.tag != expected:
                raise Failure(f"{path} is another file than it should be: its manifest has the SHA-256 {archive.tag}.")
            with progress() as bar:
                task = bar.add_task(f"check {path.name}", total=_mib(archive.size))
                check(archive, lambda done, _all: bar.update(task, completed=_mib(done)))
            return archive
    except PlacerecError as error:
        raise Failure(f"{path}: {error}") from error
    except OSError as error:
        raise Failure(f"{path} cannot be read: {error.strerror}.") from error


def _mib(size: int) -> int:
    return -(-size // MIB)


def partial_tag(path: Path) -> str | None:
    """Of which moment of a map a part of a file is, by its beginning; None where that is not there yet."""
    from core.errors import PlacerecError
    from core.storage.archives.reading import opening_of
    from core.storage.archives.tar_layout import BLOCK

    try:
        with path.open("rb") as file:

            def read_at(offset: int, size: int) -> bytes:
                file.seek(offset)
                return file.read(size)

            opening = opening_of(read_at(0, BLOCK), read_at)
    except (FileNotFoundError, PlacerecError):
        return None
    return None if opening is None else opening[2]


async def download(service: Service, map_id: str, partial: Path, known: str | None = None) -> str | None:
    """Bring a map into ``partial``, behind what is there of the same moment; checked and synced.

    Args:
        known: SHA-256 of the manifest of a file that is there already.

    Returns:
        The SHA-256 of its manifest; None if the map holds what the known file holds.

    Raises:
        Refused, Failure: it could not be had; what came of it stays, to go on from.
    """
    for _ in range(RESTARTS):
        try:
            with progress() as bar:
                tag = await _pieces(
                    service, map_id, partial, known, bar, bar.add_task(f"download {map_id}", total=None)
                )
        except Refused as refused:
            if refused.status == 304:
                partial.unlink(missing_ok=True)
                return None
            if refused.slug in ("export-gone", "range-not-satisfiable"):
                partial.unlink(missing_ok=True)
                continue
            raise
        try:
            check_file(partial, tag)
        except Failure:
            partial.unlink(missing_ok=True)  # nothing good can be put behind it
            raise
        return tag
    raise Failure(f"The map {map_id} changes faster than it can be downloaded; give PLACEREC_EXPORT_SECONDS more.")


async def _pieces(service: Service, map_id: str, partial: Path, known: str | None, bar: Progress, task: TaskID) -> str:
    path = path_of("maps", map_id, "export")
    tag = await asyncio.to_thread(partial_tag, partial)
    if tag is None:
        partial.unlink(missing_ok=True)
    with _opened(partial) as file:
        position, size = file.seek(0, os.SEEK_END), None
        while size is None or position < size:
            headers = {"Range": f"bytes={position}-{position + PIECE_BYTES - 1}"}
            if tag is not None:
                headers["If-Match"] = f'"{tag}"'
            elif known is not None:
                headers["If-None-Match"] = f'"{known}"'
            response = await _piece(service, path, headers, position)
            if response is None:  # nothing is missing
                break
            tag, size = response.headers["etag"].strip('"'), _size_of(response)
            if response.status_code == 200:
                position = file.seek(0)
                file.truncate()
            await asyncio.to_thread(file.write, response.content)
            position += len(response.content)
            bar.update(task, completed=_mib(position), total=_mib(size))
        file.flush()
        await asyncio.to_thread(os.fsync, file.fileno())
    assert tag is not None
    return tag


async def _piece(service: Service, path: str, headers: dict[str, str], position: int) -> httpx.Response | None:
    try:
        return await service.request("GET", path, headers=headers, patience=PATIENCE)
    except Refused as refused:
        if refused.slug == "range-not-satisfiable" and position:
            return None  # what is here is whole, or wrong: it is checked either way
        raise


def _size_of(response: httpx.Response) -> int:
    whole = response.headers.get("content-range", "").rpartition("/")[2]
    return int(whole) if whole else int(response.headers["content-length"])


def _opened(path: Path) -> Any:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("ab" if path.exists() else "wb")
    except OSError as error:
        raise Failure(f"{path} cannot be written: {error.strerror}.") from error


def settle(partial: Path, path: Path) -> None:
    """Give a file that is whole its name, durably.

    Raises:
        Failure: the disk refuses.
    """
    from core.disk.files import sync_folder

    try:
        os.replace(partial, path)
        sync_folder(path.absolute().parent)
    except OSError as error:
        raise Failure(f"{path} cannot be written: {error.strerror}.") from error


async def upload(service: Service, path: Path, map_id: str | None) -> dict[str, Any]:
    """Bring a file to the service; the job that makes a map of it.

    Raises:
        Refused, Failure: it is not taken.
    """
    size = path.stat().st_size
    with progress() as bar:
        task = bar.add_task(f"send {path.name}", total=_mib(size))

        async def pieces() -> AsyncIterator[bytes]:
            sent = 0
            with path.open("rb") as file:
                while piece := await asyncio.to_thread(file.read, MIB):
                    yield piece
                    sent += len(piece)
                    bar.update(task, completed=_mib(sent))

        params = {"background": "true", **({} if map_id is None else {"id": map_id})}
        headers = {"Content-Type": "application/x-tar", "Content-Length": str(size)}
        request = service.request("POST", path_of("maps", "import"), params=params, headers=headers, content=pieces())
        job: dict[str, Any] = (await request).json()
    return job
