"""Maps in the formats of other tools, made from a downloaded export file."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from service.commands.connection.client import CommandTarget, open_service, run
from service.commands.console import Failure, messages, remark
from service.commands.maps.transfers import download

if TYPE_CHECKING:
    from core.maps.formats.frames import ArchivedFrames

Format = Literal["tar", "mcap", "colmap"]


def export_as(target: CommandTarget, map_id: str, path: Path, form: Literal["mcap", "colmap"], overwrite: bool) -> None:
    """Save the frames of a map as an MCAP file or as a folder with a model of COLMAP; both are whole or not there.

    Raises:
        Failure: the map keeps no images, or the disk refuses.
    """
    from core.errors import PlacerecError
    from core.maps.archives.reading import Archive
    from core.maps.formats.frames import ArchivedFrames

    try:
        with _workplace(path) as folder:
            file = folder / "map.tar"

            async def work() -> None:
                async with open_service(target) as service:
                    await download(service, map_id, file)

            run(work())
            with Archive(file) as archive, messages.status(f"Writing {path} …"):
                frames, made = ArchivedFrames(archive), folder / "made"
                said = _as_mcap(frames, made) if form == "mcap" else _as_colmap(frames, made)
            _settle(made, path, overwrite)
    except PlacerecError as error:
        raise Failure(str(error)) from error
    except OSError as error:
        raise Failure(f"{path} cannot be written: {error.strerror}.") from error
    remark(f"{path}: {said}.")
    for reason, count in sorted(frames.left_out.items()):
        remark(f"{count} places are left out: {reason}.")


@contextmanager
def _workplace(path: Path) -> Iterator[Path]:
    """A folder beside a path, from which a file or a folder is moved to it in one step."""
    path.absolute().parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".part", dir=path.absolute().parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _settle(made: Path, path: Path, overwrite: bool) -> None:
    """Move what was made to its place; an earlier one is replaced, a folder by a new one."""
    if overwrite and path.is_dir():
        os.replace(path, made.with_name("before"))
    os.replace(made, path)


def _as_mcap(frames: ArchivedFrames, path: Path) -> str:
    from core.maps.formats.mcap import write_mcap

    made = write_mcap(frames, path)
    _check_count(made.frames)
    return f"{made.frames} frames, {made.posed} with a pose"


def _as_colmap(frames: ArchivedFrames, folder: Path) -> str:
    from core.maps.formats.colmap import write_colmap

    folder.mkdir()
    made = write_colmap(frames, folder)
    _check_count(made.frames)
    guessed = f"; the focal length of {', '.join(sorted(made.guessed))} is a guess" if made.guessed else ""
    return f"{made.frames} frames, {made.posed} with a pose and a heading{guessed}"


def _check_count(frames: int) -> None:
    if not frames:
        raise Failure("The map keeps no images of its places (its setting keep is not image).")
