"""Kept pictures that cannot be shown: they came with an imported file, or were accepted by another version."""

from __future__ import annotations

from dataclasses import replace

import pytest

from core.errors import NoThumbnail
from core.storage import Map
from tests.core.storage.frames import frame

ENDLESS = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR" + (1 << 20).to_bytes(4, "big") * 2 + bytes(9)


@pytest.mark.parametrize(
    ("content", "why"), [(ENDLESS, "1048576x1048576 pixels"), (b"<script>", "not those of an image")]
)
def test_what_cannot_be_shown_is_no_thumbnail(lab: Map, content: bytes, why: str) -> None:
    lab.edit({"keep": "image"})
    lab.enrol([replace(frame("p"), image=content)])
    with pytest.raises(NoThumbnail, match=why):
        lab.thumbnail("p")
