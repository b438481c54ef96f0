"""The index of a backup: ``index.json`` beside the files of its maps, which names them and their checksums."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from core.disk.files import write_file
from core.places import MAP_IDS

INDEX = "index.json"
FORMAT = "placerec backup"
VERSION = 1


class InvalidIndex(Exception):
    """A file is not the index of a backup, is damaged, or was written by a later version; the text says which."""


class BackupEntry(BaseModel):
    """A map of a backup; ``places`` counts looks, too; ``listed`` is whether the service had it at the last backup."""

    model_config = ConfigDict(extra="forbid")

    id: Annotated[str, MAP_IDS]
    file: str = Field(pattern=r"^[a-z0-9][a-z0-9._-]{0,100}$")
    manifest_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    bytes: int
    places: int
    saved_at: datetime
    listed: bool = True


class BackupIndex(BaseModel):
    """The maps of a backup."""

    model_config = ConfigDict(extra="forbid")

    format: str = FORMAT
    version: int = VERSION
    maps: list[BackupEntry] = []

    @classmethod
    def read(cls, folder: Path) -> BackupIndex:
        """The index of the backup in a folder.

        Raises:
            InvalidIndex: it is none that this version reads.
            OSError: there is none, or it cannot be read.
        """
        path = folder / INDEX
        try:
            index = cls.model_validate_json(path.read_bytes())
        except ValidationError as error:
            raise InvalidIndex(f"{path} is not the index of a backup, or is damaged.") from error
        if (index.format, index.version) != (FORMAT, VERSION):
            raise InvalidIndex(f"{path} was written by a later version of placerec.")
        return index

    def write(self, folder: Path) -> None:
        """Put the index into a folder, whole or not at all.

        Raises:
            OSError: the disk refuses.
        """
        write_file(folder / INDEX, (json.dumps(self.model_dump(mode="json"), indent=2) + "\n").encode())

    def find(self, map_id: str) -> BackupEntry | None:
        """The entry of a map."""
        return next((entry for entry in self.maps if entry.id == map_id), None)

    def put(self, entry: BackupEntry) -> None:
        """Add the entry of a map, in place of an earlier one."""
        self.maps = sorted([*(one for one in self.maps if one.id != entry.id), entry], key=lambda one: one.id)


def file_name(map_id: str, tag: str) -> str:
    """The name of the file of a map whose manifest has this SHA-256."""
    return f"{map_id}.{tag[:16]}.tar"
