# Written from _async/transfers.py by scripts/client.  Do not edit.
"""Maps as files: downloads in pieces that can be taken up again, and uploads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from placerec_client import problems
from placerec_client._http import httpx
from placerec_client._sync.concurrency import in_thread
from placerec_client._sync.connection import Connection
from placerec_client._sync.jobs import Job
from placerec_client.archives import check_archive, digest_of, map_id_of, partial_tag
from placerec_client.errors import TransferFailed
from placerec_client.requests import path_of, query_string

PIECE_BYTES = 16 << 20
"""Bytes of one request of a download: they are in memory at one time, and lost if the connection breaks."""

CHUNK_BYTES = 1 << 20
RESTARTS = 3
"""How often a download begins again because the service no longer stores the partly downloaded export."""

PARTIAL = ".part"
Progress = Callable[[int, int], object]
"""Is called with the bytes that are through, and their number."""


def export(
    connection: Connection,
    map_path: str,
    path: str | os.PathLike[str],
    overwrite: bool = False,
    known: str | None = None,
    progress: Progress | None = None,
) -> str | None:
    """Download a map to a file; see ``Map.export``."""
    file = file_of(path)
    if os.path.exists(file) and not overwrite:
        raise TransferFailed(f"{file} already exists.")
    partial = file.with_name(file.name + PARTIAL)
    tag = download(connection, map_path, partial, known, progress)
    if tag is not None:
        in_thread(settle, partial, file)
    return tag


def download(
    connection: Connection, map_path: str, partial: Path, known: str | None, progress: Progress | None
) -> str | None:
    """Download a map to ``partial``, after the part of the same export that is there; compare it with its checksums.

    Returns:
        The SHA-256 of the manifest; None if it is ``known``.

    Raises:
        Problem, ConnectionFailed: the download failed; its part stays, to be continued.
        TransferFailed: the file cannot be written, is damaged, or changes faster than it can be downloaded.
    """
    for _ in range(RESTARTS):
        try:
            tag = _pieces(connection, map_path + "/export", partial, known, progress)
        except (problems.ExportGone, problems.RangeNotSatisfiable):
            partial.unlink(missing_ok=True)
            continue
        if tag is None:
            partial.unlink(missing_ok=True)
            return None
        try:
            in_thread(check_archive, partial, tag)
        except TransferFailed:
            partial.unlink(missing_ok=True)  # it cannot be continued
            raise
        return tag
    raise TransferFailed("The map changes faster than it can be downloaded: increase PLACEREC_EXPORT_SECONDS.")


def _pieces(
    connection: Connection, path: str, partial: Path, known: str | None, progress: Progress | None
) -> str | None:
    tag = in_thread(partial_tag, partial)
    with _opened(partial, anew=tag is None) as file:
        position, size = file.seek(0, os.SEEK_END), None
        while size is None or position < size:
            response = _piece(connection, path, position, tag, known)
            if response is None:  # the file is complete or damaged, which is checked later
                break
            if response.status_code == 304:
                return None
            tag, size = response.headers["etag"].strip('"'), _size_of(response.headers)
            if response.status_code == 200:
                position = file.seek(0)
                file.truncate()
            content = response.content
            in_thread(_write, file, content)
            position += len(content)
            if progress is not None:
                progress(position, size)
        in_thread(_sync, file)
    return tag


def _piece(
    connection: Connection, path: str, position: int, tag: str | None, known: str | None
) -> httpx.Response | None:
    headers = {"Range": f"bytes={position}-{position + PIECE_BYTES - 1}"}
    if tag is not None:
        headers["If-Match"] = f'"{tag}"'
    elif known is not None:
        headers["If-None-Match"] = f'"{known}"'
    try:
        return connection.request("GET", path, headers=headers, accepted=(304,))
    except problems.RangeNotSatisfiable:
        if position:
            return None
        raise


def upload(
    connection: Connection,
    path: str | os.PathLike[str],
    map_id: str | None,
    encoder: str | None,
    progress: Progress | None,
) -> Job:
    """Upload the file of a map; see ``Maps.import_``."""
    file = file_of(path)
    _check_free(connection, map_id or in_thread(map_id_of, file))
    try:
        size = file.stat().st_size
        digest = in_thread(digest_of, file)
    except OSError as error:
        raise TransferFailed(f"{file} cannot be read: {error.strerror}.") from error

    def pieces() -> Iterator[bytes]:
        sent = 0
        with file.open("rb") as opened:
            while piece := in_thread(opened.read, CHUNK_BYTES):
                yield piece
                sent += len(piece)
                if progress is not None:
                    progress(sent, size)

    parameters = {"background": True, "id": map_id, "encoder": encoder}
    headers = {"Content-Length": str(size), "Content-Digest": f"sha-256=:{digest}:"}
    return Job.submit(
        connection,
        "/v1/maps/import" + query_string(parameters),
        content=pieces,
        media_type="application/x-tar",
        headers=headers,
    )


def _check_free(connection: Connection, map_id: str | None) -> None:
    """Ask whether there is a map of this id, before the file of one is sent in vain.

    Raises:
        MapExists: there is one.
    """
    if map_id is None:
        return
    try:
        connection.request("GET", path_of("maps", map_id))
    except problems.UnknownMap:
        return
    except problems.MapQuarantined:
        pass
    kind = {"type": "urn:placerec:problem:map-exists", "title": "A map of this id already exists"}
    raise problems.MapExists({**kind, "status": 409, "detail": f"There is a map {map_id!r} already."}, 409)


def settle(partial: Path, path: Path) -> None:
    """Give a complete file its final name, and sync the folder.

    Raises:
        TransferFailed: the file cannot be renamed.
    """
    try:
        os.replace(partial, path)
        folder = os.open(path.absolute().parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise TransferFailed(f"{path} cannot be written: {error.strerror}.") from error


def file_of(path: str | os.PathLike[str]) -> Path:
    """The path of a file.

    Raises:
        TransferFailed: it is none.
    """
    try:
        found = Path(path)
        is_one = b"\0" not in os.fsencode(found)
    except TypeError as error:
        raise TransferFailed(f"A {type(path).__name__} is no path of a file.") from error
    except UnicodeEncodeError:
        is_one = False
    if not is_one:
        raise TransferFailed(f"{ascii(str(found))[:140]} is no path of a file: it has a character that none has.")
    return found


def _size_of(headers: Mapping[str, str]) -> int:
    whole = headers.get("content-range", "").rpartition("/")[2]
    return int(whole) if whole else int(headers["content-length"])


def _opened(path: Path, anew: bool) -> BinaryIO:
    try:
        if anew:
            path.unlink(missing_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        return open(path, "ab" if path.exists() else "wb", opener=_open_private)
    except OSError as error:
        raise TransferFailed(f"{path} cannot be written: {error.strerror}.") from error


def _open_private(path: str, flags: int) -> int:
    """For this user alone, if it is a new file: a map has pictures of rooms."""
    return os.open(path, flags, 0o600)


def _write(file: BinaryIO, content: bytes) -> None:
    try:
        file.write(content)
    except OSError as error:
        raise TransferFailed(f"{file.name} cannot be written: {error.strerror}.") from error


def _sync(file: BinaryIO) -> None:
    file.flush()
    os.fsync(file.fileno())
