"""Kept pictures that cannot be shown: they came with a file from elsewhere, or were accepted by another version."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime

import pytest

from core.errors import NoThumbnail
from core.places import Place
from core.storage.pictures import small_picture


def test_what_cannot_be_shown_is_no_thumbnail() -> None:
    now = datetime.now(UTC)
    place = Place(id="p", regions=1, picture="image", created_at=now, updated_at=now)
    endless = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR" + (1 << 20).to_bytes(4, "big") * 2 + bytes(9)
    for content, why in ((endless, "1048576x1048576 pixels"), (b"<script>", "not those of an image")):
        with pytest.raises(NoThumbnail, match=why):
            small_picture(place, (content, hashlib.sha256(content).digest()))
