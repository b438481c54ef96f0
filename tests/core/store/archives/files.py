"""Export files made by hand: right ones, and such as somebody would make who means harm."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from core.maps.archives.lines import MOST_PICTURE_BYTES
from core.maps.archives.manifest import seal_of
from core.maps.archives.reading import Archive
from core.maps.archives.tar_layout import header, padded
from core.maps.status import no_progress
from core.store import Map, Store

Parts = dict[str, bytes]


def exported(map_: Map, path: Path) -> bytes:
    """The whole file of a map, which is written to ``path`` and removed."""
    map_.exporter.write(path)
    try:
        return path.read_bytes()
    finally:
        path.unlink()


def parts_of(content: bytes) -> tuple[dict[str, Any], Parts]:
    """The manifest and the parts of a file, as anybody's tar reads them."""
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        parts: Parts = {}
        for member in archive:
            file = archive.extractfile(member)
            assert file is not None
            parts[member.name] = file.read()
    del parts["manifest.sha256"]
    return json.loads(parts.pop("manifest.json")), parts


def sealed(manifest: Mapping[str, Any], parts: Parts) -> bytes:
    """A file of these parts, whose manifest has their lengths and checksums: only what they say can be wrong."""
    listed = [
        {**entry, "bytes": len(parts[entry["name"]]), "sha256": hashlib.sha256(parts[entry["name"]]).hexdigest()}
        for entry in manifest["parts"]
    ]
    return named(json.dumps({**manifest, "parts": listed}).encode(), parts)


def named(manifest: bytes, parts: Mapping[str, bytes]) -> bytes:
    """A file of any manifest and any members behind it."""
    return taped({"manifest.json": manifest, "manifest.sha256": seal_of(manifest), **parts})


def taped(members: Mapping[str, bytes]) -> bytes:
    """A tar of members in this order."""
    whole = b"".join(header(name, len(data)) + data.ljust(padded(len(data)), b"\0") for name, data in members.items())
    return whole + bytes(1024)


def changed(content: bytes, change: Callable[[dict[str, Any], Parts], None]) -> bytes:
    """A file after a change of its manifest and parts, sealed anew."""
    manifest, parts = parts_of(content)
    change(manifest, parts)
    return sealed(manifest, parts)


def line_changed(content: bytes, part: str, number: int, **values: Any) -> bytes:
    """A file with other values in one line of a part."""

    def change(_manifest: dict[str, Any], parts: Parts) -> None:
        lines = parts[part].splitlines()
        lines[number] = json.dumps({**json.loads(lines[number]), **values}).encode()
        parts[part] = b"\n".join(lines) + b"\n"

    return changed(content, change)


def grown(work: Callable[[], object]) -> int:
    """By how many bytes this process grew, at most, while it did some work."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak is what there is now
    before = _peak()
    work()
    return _peak() - before


def _peak() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM"))


def imported(
    store: Store,
    path: Path,
    map_id: str,
    advance: Callable[[int, int], None] = no_progress,
    check_picture: Callable[[bytes], None] = lambda _: None,
    most_picture_bytes: int = MOST_PICTURE_BYTES,
    before_listing: Callable[[int], None] = lambda _: None,
) -> Map:
    """The map of a file, listed."""
    with Archive(path) as archive:
        store.import_map(archive, map_id, advance, check_picture, most_picture_bytes, before_listing)
    return store.get(map_id)
