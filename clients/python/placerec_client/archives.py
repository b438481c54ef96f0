"""Files of exported maps: their tags, and the check that one is whole."""

from __future__ import annotations

import base64
import hashlib
import json
import tarfile
from pathlib import Path
from typing import IO, Any

from placerec_client.errors import TransferFailed

MANIFEST, SEAL = "manifest.json", "manifest.sha256"
CHUNK_BYTES = 1 << 20


def partial_tag(path: Path) -> str | None:
    """The SHA-256 of the manifest at the beginning of a file; None if it is not complete there, or damaged."""
    try:
        with tarfile.open(path, "r:") as tar:
            text = _content(tar, MANIFEST)
            seal = _content(tar, SEAL)
    except (OSError, tarfile.TarError, TransferFailed, EOFError):
        return None
    tag = hashlib.sha256(text).hexdigest()
    return tag if seal.split()[:1] == [tag.encode()] else None


def map_id_of(path: Path) -> str | None:
    """The id of the map that a file states; None if its beginning is not that of a map's file."""
    try:
        with tarfile.open(path, "r:") as tar:
            found = json.loads(_content(tar, MANIFEST))["map"]["id"]
    except (OSError, tarfile.TarError, TransferFailed, EOFError, ValueError, KeyError, TypeError):
        return None
    return found if isinstance(found, str) else None


def check_archive(path: Path, expected: str | None = None) -> str:
    """Compare all parts of a file with the SHA-256 in its manifest; return that of the manifest.

    Args:
        expected: the value that it must have; None for any.

    Raises:
        TransferFailed: the file cannot be read, is cut or damaged, or is another one.
    """
    tag = partial_tag(path)
    if tag is None:
        raise TransferFailed(f"{path} is no whole file of a map.")
    if expected is not None and tag != expected:
        raise TransferFailed(f"{path} is another file: its manifest has the SHA-256 {tag}.")
    try:
        with tarfile.open(path, "r:") as tar:
            manifest: dict[str, Any] = json.loads(_content(tar, MANIFEST))
            _content(tar, SEAL)
            for part in manifest["parts"]:
                if _hash(_member(tar, part["name"])).hexdigest() != part["sha256"]:
                    raise TransferFailed(f"{path} is damaged: {part['name']} does not match its SHA-256.")
    except OSError as error:
        raise TransferFailed(f"{path} cannot be read: {error.strerror}.") from error
    except (tarfile.TarError, EOFError, ValueError, KeyError, TypeError) as error:
        raise TransferFailed(f"{path} is cut or damaged: {error}.") from error
    return tag


def digest_of(path: Path) -> str:
    """The SHA-256 of a file, as Content-Digest has it.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        return base64.b64encode(_hash(file).digest()).decode()


def _hash(file: IO[bytes]) -> hashlib._Hash:
    found = hashlib.sha256()
    while chunk := file.read(CHUNK_BYTES):
        found.update(chunk)
    return found


def _member(tar: tarfile.TarFile, name: str) -> IO[bytes]:
    """The next member of a file, which must have this name."""
    member = tar.next()
    file = None if member is None or member.name != name else tar.extractfile(member)
    if file is None:
        raise TransferFailed(f"The file does not have {name} where it belongs.")
    return file


def _content(tar: tarfile.TarFile, name: str) -> bytes:
    return _member(tar, name).read()
