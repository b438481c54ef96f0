"""The files of the console as they are sent: read once, compressed once, and named by what they contain."""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

FOLDER = Path(__file__).parent
PAGE = "page.html"

TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
"""The content type of each kind of file; files of other kinds are not served."""

BUILD = "{build}"
"""The placeholder in the page for the name of the folder of its files."""


@dataclass(frozen=True)
class ConsoleFile:
    """One file.

    Args:
        content: its bytes.
        compressed: the same by gzip.
        media_type: its content type.
        tag: the SHA-256 of the content, in hex.
    """

    content: bytes
    compressed: bytes
    media_type: str
    tag: str

    @classmethod
    def of(cls, content: bytes, media_type: str) -> ConsoleFile:
        """The file of these bytes."""
        return cls(content, gzip.compress(content, mtime=0), media_type, hashlib.sha256(content).hexdigest())


@dataclass(frozen=True)
class ConsoleFiles:
    """All files of the console.

    Args:
        page: the page, which names the folder of the others.
        build: that folder's name, which changes with any of its files, so that a browser may keep them for good.
        others: the other files by their path.
    """

    page: ConsoleFile
    build: str
    others: dict[str, ConsoleFile]


@lru_cache(1)
def console_files() -> ConsoleFiles:
    """The files, read from disk at the first call."""
    found = {
        path.relative_to(FOLDER).as_posix(): ConsoleFile.of(path.read_bytes(), TYPES[path.suffix])
        for path in sorted(FOLDER.rglob("*"))
        if path.suffix in TYPES and path.is_file()
    }
    text = found.pop(PAGE).content.decode()
    names = "".join(f"{path} {file.tag}\n" for path, file in found.items())
    build = hashlib.sha256(names.encode()).hexdigest()[:16]
    return ConsoleFiles(ConsoleFile.of(text.replace(BUILD, build).encode(), TYPES[".html"]), build, found)
