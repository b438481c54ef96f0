"""``placerec maps export`` and ``import``: a map as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.commands.connection.client import AsJson, DataDir, Target, Url, open_service, run
from service.commands.connection.downloads import PARTIAL, check_file, download, settle, upload
from service.commands.console import Failure, remark
from service.commands.jobs import Wait, followed, tell

MapId = Annotated[str, typer.Argument(metavar="MAP", help="The map's id.", show_default=False)]
File = Annotated[Path, typer.Argument(metavar="FILE", help="A tar.", show_default=False)]


def export(
    map_id: MapId,
    file: File,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file of that name.")] = False,
    url: Url = None,
    data_dir: DataDir = None,
) -> None:
    """Save a map as a file; a download that broke off goes on where it was when the command is run again."""
    if file.exists() and not overwrite:
        raise Failure(f"{file} is there already; --overwrite replaces it.")
    partial = file.with_name(file.name + PARTIAL)

    async def work() -> str | None:
        async with open_service(Target(url, data_dir)) as service:
            return await download(service, map_id, partial)

    tag = run(work())
    settle(partial, file)
    remark(f"The map {map_id} is in {file}; the SHA-256 of its manifest is {tag}.")


def import_(
    file: File,
    map_id: Annotated[str | None, typer.Option("--id", help="Id of the new map; default: the file's own.")] = None,
    wait: Wait = True,
    url: Url = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Make a map of a file; it is listed when all of it was checked, or not at all."""
    if not wait and url is None:
        raise Failure("Without --url the service ends with this command, and the job would only go on with the next.")
    check_file(file)

    async def work() -> dict[str, object]:
        async with open_service(Target(url, data_dir)) as service:
            job = await upload(service, file, map_id)
            return await followed(service, job) if wait else job

    tell(run(work()), as_json)
