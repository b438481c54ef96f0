"""Transfer of map files between a service and the disk, with progress bars; and their check against their checksums."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.commands.connection.client import Service, failures, path_of
from service.commands.console import Failure, progress

if TYPE_CHECKING:
    from core.maps.archives.reading import Archive

PATIENCE = 3600.0
"""Seconds for which the request for a piece is repeated while the service is overloaded, restarts or writes the file of
a map, which for 100 000 places takes minutes."""

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
    from core.maps.archives.reading import Archive, check

    try:
        with Archive(path) as archive:
            if expected is not None and archive.tag != expected:
                raise Failure(f"{path} is not the expected file: its manifest has the SHA-256 {archive.tag}.")
            with _bar(f"check {path.name}") as advance:
                check(archive, advance)
            return archive
    except PlacerecError as error:
        raise Failure(f"{path}: {error}") from error
    except OSError as error:
        raise Failure(f"{path} cannot be read: {error.strerror}.") from error


async def download(
    service: Service, map_id: str, path: Path, known: str | None = None, overwrite: bool = False
) -> str | None:
    """Download a map to a file, after the part of the same export that is there; check it and sync it to disk.

    Args:
        service: which has the map.
        map_id: of the map.
        path: the file to write.
        known: SHA-256 of the manifest of an earlier download.
        overwrite: whether an existing file is replaced.

    Returns:
        The SHA-256 of the manifest; None if the map has not changed since the earlier download.

    Raises:
        Refused, Failure: the download failed; its part stays, to be continued.
    """
    with failures(), _bar(f"download {map_id}") as advance:
        lab = service.patient(PATIENCE).maps[map_id]
        return await lab.export(path, overwrite=overwrite, known=known, progress=advance)


async def upload(service: Service, path: Path, map_id: str | None) -> dict[str, Any]:
    """Upload a file to the service; return the job that creates a map from it.

    Raises:
        Refused, Failure: the service refuses the file, or does not answer.
    """
    with failures(), _bar(f"send {path.name}") as advance:
        job = await service.client.maps.import_(path, id=map_id, progress=advance)
    found: dict[str, Any] = await service.get(path_of("jobs", job.id))
    return found


@contextmanager
def _bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar in mebibytes: a function that takes the number of bytes that are done, and their total."""
    with progress() as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, size: bar.update(task, completed=-(-done // MIB), total=-(-size // MIB))
