"""The folder of scheduled backups: a folder for each of them, and the schedule.

    2026-11-27T021500Z/       a backup, as ``placerec backup`` verifies and restores it
    .2026-11-27T021500Z/      one that is being written
    schedule.json             how often, and how many are kept

The file of a map that has not changed since the backup before is the same one under a second name (a hard link), so
that it takes no room again; where a file system has no such links it is copied.
"""

from __future__ import annotations

import os
import re
import shutil
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from core.disk.files import make_folder, sync_file, sync_folder, write_file
from core.disk.permissions import PRIVATE_FOLDER
from service.backups.index import BackupIndex, InvalidIndex

SCHEDULE = "schedule.json"
NAME = re.compile(r"\d{4}-\d\d-\d\dT\d{6}Z")
FORM = "%Y-%m-%dT%H%M%SZ"


class BackupSchedule(BaseModel):
    """How often all maps are saved, and how many backups are kept."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"hours": 24, "keep": 7}]})

    hours: float | None = Field(
        default=24,
        ge=0.25,
        le=24 * 366,
        allow_inf_nan=False,
        description="Hours from the beginning of one backup to that of the next; null: none is made by itself.",
    )
    keep: int = Field(
        default=7, strict=True, ge=1, le=1000, description="How many are kept; the oldest ones above that are deleted."
    )


@dataclass(frozen=True)
class Backup:
    """A backup that is complete.

    name: of its folder.
    at: when it was begun.
    """

    name: str
    at: datetime
    index: BackupIndex


class Shelf:
    """The folder of scheduled backups.

    Raises, in every method:
        OSError: the disk refuses.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def schedule(self) -> BackupSchedule:
        """The schedule; the default one until another is stored, or if it cannot be read."""
        try:
            return BackupSchedule.model_validate_json((self.folder / SCHEDULE).read_bytes())
        except (FileNotFoundError, ValidationError):
            return BackupSchedule()

    def set_schedule(self, schedule: BackupSchedule) -> None:
        """Store another schedule."""
        make_folder(self.folder)
        write_file(self.folder / SCHEDULE, schedule.model_dump_json().encode())

    def backups(self) -> list[Backup]:
        """The complete backups, the newest first; folders without a good index are passed over."""
        found = []
        for name in sorted(self.names(), reverse=True):
            with suppress(InvalidIndex, FileNotFoundError, NotADirectoryError):
                found.append(Backup(name, moment_of(name), BackupIndex.read(self.folder / name)))
        return found

    def names(self) -> list[str]:
        """The names of the complete backups, in no order."""
        return [name for name in os.listdir(self.folder) if NAME.fullmatch(name)] if self.folder.exists() else []

    def newest(self) -> datetime | None:
        """When the newest complete backup was begun; None: there is none."""
        name = max(self.names(), default=None)
        return None if name is None else moment_of(name)

    def begin(self, name: str) -> Path:
        """Make the folder of a backup that is to be written, or find what there is of it; others are removed."""
        make_folder(self.folder)
        for path in self.folder.glob(".*Z"):
            if path.name != f".{name}" and NAME.fullmatch(path.name[1:]):
                shutil.rmtree(path)
        begun = self.folder / f".{name}"
        begun.mkdir(PRIVATE_FOLDER, exist_ok=True)
        return begun

    def complete(self, name: str) -> None:
        """List a backup that was written."""
        begun = self.folder / f".{name}"
        sync_folder(begun)
        begun.rename(self.folder / name)
        sync_folder(self.folder)

    def discard(self, name: str) -> None:
        """Remove what there is of a backup that is not complete."""
        shutil.rmtree(self.folder / f".{name}", ignore_errors=True)

    def thin_out(self, keep: int) -> int:
        """Delete the oldest backups but for ``keep``; how many were deleted."""
        old = self.backups()[keep:]
        for backup in old:
            gone = self.folder / f".{backup.name}"
            (self.folder / backup.name).rename(gone)  # a crash leaves no half of one that is listed
            shutil.rmtree(gone)
        return len(old)


def name_of(moment: datetime) -> str:
    """The name of a backup that is begun at a moment."""
    return moment.astimezone(UTC).strftime(FORM)


def moment_of(name: str) -> datetime:
    """When the backup of this name was begun."""
    return datetime.strptime(name, FORM).replace(tzinfo=UTC)


def take_over(known: Path, size: int, file: Path) -> None:
    """Give a file of an earlier backup a second name; copy it where that cannot be.

    Raises:
        FileNotFoundError: it is gone, or has not its size any more.
        OSError: the disk refuses.
    """
    if known.stat().st_size != size:
        raise FileNotFoundError(known)
    file.unlink(missing_ok=True)
    try:
        os.link(known, file)
    except FileNotFoundError:
        raise
    except OSError:
        shutil.copyfile(known, file)
        sync_file(file)
