"""Maps as files: ``placerec maps export`` and ``import`` for one map, ``placerec backup`` for all maps.

DIR/index.json              the saved maps, each with its file and the SHA-256 of that file's manifest
DIR/<map>.<sha256…>.tar     a file is never overwritten: a new one has a name of its own, which the index then names
DIR/.<map>.part             what there is of a file that is being written; no other file's name begins so
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from core.errors import InvalidIdentifier
from core.places import MAP_IDS
from service.backups.index import INDEX, BackupEntry, BackupIndex, InvalidIndex, file_name
from service.backups.shelf import NAME
from service.commands.connection.client import (
    AsJson,
    CommandTarget,
    DataDir,
    MapId,
    Refused,
    Service,
    Url,
    open_service,
    path_of,
    run,
)
from service.commands.console import Commands, Failure, complain, remark, show, table
from service.commands.jobs import Wait, check_outlives, followed, show_outcome
from service.commands.maps.formats import Format, export_as
from service.commands.maps.transfers import check_file, download, upload

backup = typer.Typer(cls=Commands, help="Save all maps in a folder, verify them, restore them.", no_args_is_help=True)

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the backup.", show_default=False)]
Maps = Annotated[list[str] | None, typer.Option("--map", "-m", help="Only this map; may be repeated.")]

File = Annotated[Path, typer.Argument(metavar="FILE", help="A tar file.", show_default=False)]
Target = Annotated[Path, typer.Argument(metavar="FILE", help="A file or, for colmap, a folder.", show_default=False)]


def export(
    map_id: MapId,
    file: Target,
    form: Annotated[
        Format,
        typer.Option(
            "--format",
            help="tar: all of the map, to import it again; mcap: its frames as ROS 2 messages; colmap: a folder with "
            "its frames and a sparse model of COLMAP.",
        ),
    ] = "tar",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
    url: Url = None,
    data_dir: DataDir = None,
) -> None:
    """Save a map as a file. An interrupted download of a tar file continues when the command is run again.

    The formats of other tools are made here of a tar file that is downloaded first, and need a map that keeps images.
    """
    if file.exists() and not overwrite:
        raise Failure(f"{file} already exists. Give --overwrite to replace it.")
    if form != "tar":
        export_as(CommandTarget(url, data_dir), map_id, file, form, overwrite)
        return

    async def work() -> str | None:
        async with open_service(CommandTarget(url, data_dir)) as service:
            return await download(service, map_id, file, overwrite=overwrite)

    tag = run(work())
    remark(f"The map {map_id} is in {file}; the SHA-256 of its manifest is {tag}.")


def import_(
    file: File,
    map_id: Annotated[str | None, typer.Option("--id", help="Id of the new map; default: the id in the file.")] = None,
    wait: Wait = True,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Create a map from a file, after all of the file was checked."""
    check_outlives(CommandTarget(url, data_dir), wait)
    check_file(file)

    async def work() -> dict[str, object]:
        async with open_service(CommandTarget(url, data_dir)) as service:
            job = await upload(service, file, map_id)
            return await followed(service, job) if wait else job

    show_outcome(run(work()), as_json)


def read_index(folder: Path) -> BackupIndex:
    """The index of a backup.

    Raises:
        Failure: there is no index, or it cannot be read; of a folder in which a service keeps its backups, the text
            names the latest of them.
    """
    try:
        return BackupIndex.read(folder)
    except FileNotFoundError as error:
        if kept := sorted(path.parent for path in folder.glob(f"*/{INDEX}") if NAME.fullmatch(path.parent.name)):
            raise Failure(f"{folder} holds {len(kept)} backups: name one of them; the latest is {kept[-1]}.") from error
        raise Failure(f"{folder / INDEX} cannot be read: {error.strerror}.") from error
    except OSError as error:
        raise Failure(f"{folder / INDEX} cannot be read: {error.strerror}.") from error
    except InvalidIndex as error:
        raise Failure(str(error)) from error


@backup.command("create")
def create(folder: Folder, only: Maps = None, url: Url = None, data_dir: DataDir = None) -> None:
    """Save every map. A map that has not changed since its file was written is not written again.

    Maps that the service no longer has stay in the folder until they are removed by hand.
    """
    with _held(folder):
        index = read_index(folder) if (folder / INDEX).exists() else BackupIndex()

        async def work() -> list[str]:
            async with open_service(CommandTarget(url, data_dir)) as service:
                return await _save_all(service, folder, index, only)

        failed = run(work())
        _remove_strays(folder, index)
    if failed:
        raise Failure(f"These maps could not be saved: {', '.join(failed)}.")


async def _save_all(service: Service, folder: Path, index: BackupIndex, only: list[str] | None) -> list[str]:
    """Save maps one after the other; return those that could not be saved."""
    pages = [page async for page in service.pages(path_of("maps"))]
    there = [_checked(item["id"]) for page in pages for item in page["items"]]
    failed = [_checked(item["id"]) for item in pages[0]["quarantined"] if only is None or item["id"] in only]
    for map_id in failed:
        complain(f"{map_id} is damaged and out of service; its earlier file stays.")
    if missing := set(only or ()) - {*there, *failed}:
        raise Failure(f"The service has no map {', '.join(sorted(missing))}.")
    for entry in index.maps:
        entry.listed = entry.id in there or entry.id in failed
    for map_id in there:
        if only is None or map_id in only:
            try:
                await _save(service, folder, index, map_id)
            except Failure as failure:
                complain(f"{map_id}: {failure}")
                failed.append(map_id)
    _write_index(folder, index)
    return failed


def _checked(map_id: Any) -> str:
    """An id from a service's answer.

    Raises:
        Failure: it is none, and a file of its name might be anywhere.
    """
    try:
        return MAP_IDS.check(map_id if isinstance(map_id, str) else "")
    except InvalidIdentifier as error:
        raise Failure(f"The service names a map {map_id!r}, which is no id of a map. Nothing was saved.") from error


async def _save(service: Service, folder: Path, index: BackupIndex, map_id: str) -> None:
    before = index.find(map_id)
    known = None
    if before is not None:
        with suppress(Failure):  # a missing or damaged file is written again
            check_file(folder / before.file, before.manifest_sha256)
            known = before.manifest_sha256
    downloaded = folder / f".{map_id}"  # no name of a map begins so: a map named index.json would replace the index
    tag = await download(service, map_id, downloaded, known, overwrite=True)
    if tag is None:
        remark(f"{map_id}: unchanged.")
        return
    file = folder / file_name(map_id, tag)
    _rename(downloaded, file)
    archive = _manifest_of(file)
    entry = BackupEntry(
        id=map_id,
        file=file.name,
        manifest_sha256=tag,
        bytes=file.stat().st_size,
        places=archive.places,
        saved_at=datetime.now(UTC),
    )
    index.put(entry)
    _write_index(folder, index)
    remark(f"{map_id}: {entry.places} places and looks in {file.name}.")


def _rename(downloaded: Path, file: Path) -> None:
    """Give a complete file its name, and sync the folder."""
    from core.disk.files import sync_folder

    try:
        downloaded.replace(file)
        sync_folder(file.absolute().parent)
    except OSError as error:
        raise Failure(f"{file} cannot be written: {error.strerror}.") from error


def _manifest_of(file: Path) -> Any:
    from core.maps.archives.reading import Archive

    with Archive(file) as archive:
        return archive.manifest


def _write_index(folder: Path, index: BackupIndex) -> None:
    try:
        index.write(folder)
    except OSError as error:
        raise Failure(f"{folder / INDEX} cannot be written: {error.strerror}.") from error


def _remove_strays(folder: Path, index: BackupIndex) -> None:
    """Remove earlier files of maps, which the index no longer names."""
    named = {entry.file for entry in index.maps}
    for entry in index.maps:
        for path in folder.glob(f"{entry.id}.{'[0-9a-f]' * 16}.tar"):
            if path.name not in named:
                path.unlink(missing_ok=True)


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """The folder for this process alone."""
    from core.disk.files import FolderLock, make_folder
    from core.errors import DataDirectoryLocked

    try:
        make_folder(folder)
        lock = FolderLock(folder / "LOCK")
    except DataDirectoryLocked as error:
        raise Failure(f"Another process is writing to {folder}.") from error
    except OSError as error:
        raise Failure(f"{folder} cannot be written: {error.strerror}.") from error
    try:
        yield
    finally:
        lock.release()


@backup.command("verify")
def verify(folder: Folder, only: Maps = None) -> None:
    """Read every file of a backup and compare it with its checksums. This needs no service."""
    index, damaged = read_index(folder), []
    shown = table("map", "#places and looks", "#bytes", "saved", "state")
    for entry in _chosen(index, only):
        state = "good" if entry.listed else "good; no longer in the service"
        try:
            check_file(folder / entry.file, entry.manifest_sha256)
        except Failure as failure:
            state = str(failure)
            damaged.append(entry.id)
        saved = entry.saved_at.isoformat(timespec="seconds")
        shown.add_row(entry.id, str(entry.places), str(entry.bytes), saved, state)
    show(shown)
    if damaged:
        raise Failure(f"Damaged: {', '.join(damaged)}.")


@backup.command("restore")
def restore(folder: Folder, only: Maps = None, url: Url = None, data_dir: DataDir = None) -> None:
    """Create maps from the files of a backup. Maps that exist are reported and left as they are.

    Maps that the service no longer had when the backup was last made are restored only if --map names them.
    """
    entries = [entry for entry in _chosen(read_index(folder), only) if entry.listed or only]

    async def work() -> list[str]:
        failed = []
        async with open_service(CommandTarget(url, data_dir)) as service:
            for entry in entries:
                try:
                    await _restore(service, folder, entry)
                except Failure as failure:
                    complain(f"{entry.id}: {failure}")
                    failed.append(entry.id)
        return failed

    if failed := run(work()):
        raise Failure(f"These maps were not restored: {', '.join(failed)}.")


async def _restore(service: Service, folder: Path, entry: BackupEntry) -> None:
    file = folder / entry.file
    check_file(file, entry.manifest_sha256)
    job = await followed(service, await upload(service, file, entry.id))
    if job["state"] != "succeeded":
        problem = job["problem"] or {"detail": f"the job {job['id']} was {job['state']}", "status": 500}
        raise Refused(problem["status"], "", problem["detail"])
    remark(f"{entry.id}: {job['result']['places']} places.")


def _chosen(index: BackupIndex, only: list[str] | None) -> list[BackupEntry]:
    if only is None:
        return index.maps
    if missing := [map_id for map_id in only if index.find(map_id) is None]:
        raise Failure(f"The backup has no map {', '.join(missing)}.")
    return [entry for entry in index.maps if entry.id in only]
