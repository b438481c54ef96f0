"""Transfer of map files between a service and the disk: in pieces, resumable, and checked."""

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
"""Bytes of one request: they are in memory at one time, and lost if the connection breaks."""

PATIENCE = 3600.0
"""Seconds for which the request for a piece is repeated while the service is overloaded, restarts or writes the file of
a map, which for 100 000 places takes minutes."""

RESTARTS = 3
"""How often a download begins again because the service no longer keeps the export of which a part is here."""

PARTIAL = ".part"
MIB = 1 << 20


def check_file(path: Path, expected: str | None = None) -> Archive:
    """Check that all parts of a file have the SHA-256 that its manifest says; return the closed archive.

    Args:
        path: the file.
        expected: the SHA-256 that the manifest must have; None for any.

    Raises:
        Failure: the file cannot be read, is damaged, or is another file than expected.
    """
    from core.errors import PlacerecError
    from core.storage.archives.reading import Archive, check

    try:
        with Archive(path) as archive:
            if expected is not None and archive.tag != expected:
                raise Failure(f"{path} is not the expected file: its manifest has the SHA-256 {archive.tag}.")
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
    """The SHA-256 of the manifest at the beginning of a partial file; None if the manifest is not complete yet."""
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
    """Download a map to ``partial``, after the part of the same export that is there; check it and sync it to disk.

    Args:
        service: which has the map.
        map_id: of the map.
        partial: the file to write.
        known: SHA-256 of the manifest of an earlier download.

    Returns:
        The SHA-256 of the manifest; None if the map has not changed since the earlier download.

    Raises:
        Refused, Failure: the download failed; its part stays, to be continued.
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
            partial.unlink(missing_ok=True)  # it cannot be continued
            raise
        return tag
    raise Failure(f"The map {map_id} changes faster than it can be downloaded. Increase PLACEREC_EXPORT_SECONDS.")


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
            if response is None:  # the file is complete
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
            return None  # the file is complete or damaged, which is checked later
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
    """Give a complete file its final name, and sync the folder.

    Raises:
        Failure: the file cannot be renamed.
    """
    from core.disk.files import sync_folder

    try:
        os.replace(partial, path)
        sync_folder(path.absolute().parent)
    except OSError as error:
        raise Failure(f"{path} cannot be written: {error.strerror}.") from error


async def upload(service: Service, path: Path, map_id: str | None) -> dict[str, Any]:
    """Upload a file to the service; return the job that creates a map from it.

    Raises:
        Refused, Failure: the service refuses the file, or does not answer.
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
