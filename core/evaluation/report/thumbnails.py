"""Small copies of the data set's images, each stored once in the page however often it is shown."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from core.errors import InvalidImage
from core.evaluation.report.text import escape
from core.frames.containers import read_header
from core.frames.images import decode, encode_thumbnail

if TYPE_CHECKING:
    from core.baselines.encoders import Box

LONGEST = 256
"""Pixels of a small copy's longer side."""

BUDGET = 2_200_000
"""Bytes that all small copies together may take, before they are encoded as text."""


@dataclass(frozen=True)
class Thumbnail:
    """A small copy: its id in the page, and its size in pixels."""

    id: str
    width: int
    height: int


class Thumbnails:
    """Small copies of the images that the page shows."""

    def __init__(self, budget: int = BUDGET) -> None:
        self.left = budget
        self._known: dict[Path, Thumbnail | None] = {}
        self._data: list[str] = []

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
            jpeg = encode_thumbnail(decode(path.read_bytes()), longest_side=LONGEST, quality=76)
        except (OSError, InvalidImage):
            return None
        header = read_header(jpeg)
        made = Thumbnail(f"picture-{len(self._data)}", header.width, header.height)
        self._data.append(
            f'<image id="{made.id}" width="{made.width}" height="{made.height}" href="{data_uri(jpeg, "image/jpeg")}"/>'
        )
        self.left -= len(jpeg)
        return made

    def definitions(self) -> str:
        """The element that holds the copies; ``show`` refers to it."""
        return f'<svg width="0" height="0" class="store" aria-hidden="true"><defs>{"".join(self._data)}</defs></svg>'


def data_uri(data: bytes, media_type: str) -> str:
    """A file as an address that holds it."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"


def show(thumbnail: Thumbnail, alt: str, boxes: Sequence[Box] = ()) -> str:
    """The HTML of a thumbnail, with its regions of interest drawn.

    Args:
        boxes: left, top, right, bottom, as fractions of width and height.
    """
    width, height = thumbnail.width, thumbnail.height
    frames = "".join(
        f'<rect x="{left * width:.1f}" y="{top * height:.1f}" width="{(right - left) * width:.1f}" '
        f'height="{(bottom - top) * height:.1f}"/>'
        for left, top, right, bottom in boxes
    )
    regions = f'<g class="regions">{frames}</g>' if frames else ""
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(alt)}">'
        f'<use href="#{thumbnail.id}"/>{regions}</svg>'
    )
