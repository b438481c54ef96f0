"""Small copies of the data set's images, each stored once in the page however often it is shown."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

from core.errors import InvalidImage
from core.frames.containers import read_header
from core.frames.images import decode, encode_thumbnail
from core.recordings.pictures import sendable

LONGEST = 256
"""Pixels of a small copy's longer side."""

BUDGET = 2_200_000
"""Bytes that all small copies together may take, before they are encoded as text."""


@dataclass(frozen=True)
class Thumbnail:
    """A small copy: its id in the page, its size in pixels, and the address that holds it."""

    id: str
    width: int
    height: int
    address: str


class Thumbnails:
    """Small copies of the images that the page shows."""

    def __init__(self, budget: int = BUDGET) -> None:
        self.left = budget
        self.retained: list[Thumbnail] = []
        self._known: dict[Path, Thumbnail | None] = {}

    @property
    def full(self) -> bool:
        """Nothing more should be added."""
        return self.left <= 0

    def add(self, path: Path) -> Thumbnail | None:
        """Keep a small copy; None where the file is gone, or no longer holds an image."""
        if path not in self._known:
            self._known[path] = self._shrink(path)
        return self._known[path]

    def _shrink(self, path: Path) -> Thumbnail | None:
        try:
            jpeg = encode_thumbnail(decode(sendable(path.read_bytes())), longest_side=LONGEST, quality=76)
        except (OSError, InvalidImage):
            return None
        header = read_header(jpeg)
        made = Thumbnail(f"picture-{len(self.retained)}", header.width, header.height, data_uri(jpeg, "image/jpeg"))
        self.retained.append(made)
        self.left -= len(jpeg)
        return made


def data_uri(data: bytes, media_type: str) -> str:
    """A file as an address that holds it."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"
