"""A cache of measurements, keyed by the content of everything that they depend on.

An entry is one file: a SHA-256 and the ``.npz`` bytes (JSON and arrays) that it covers, written whole
or not at all.  An entry that cannot be read counts as absent.  The folder can be deleted at any time.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.disk.files import replacing
from core.errors import InvalidTraverse
from core.networks.identity import canonical_json, json_digest

FORMAT = "placerec-evaluation/1"
VALUES = "values"
LIBRARIES = ("faiss-cpu", "numba", "numpy", "opencv-python-headless", "scipy", "torch")

NOT_COMPUTING = (
    "core/belief/",
    "core/disk/",
    "core/index/",
    "core/outage.py",
    "core/recordings/",
    "core/store/",
    "core/upkeep/",
    "lab/commands/",
    "lab/conversion/",
    "lab/evaluation/cache.py",
    "lab/evaluation/data/datasets.py",
    "lab/evaluation/report/",
    "lab/training/",
)
"""Code that no figure of an evaluation depends on."""

DIGEST_BYTES = 32


@dataclass(frozen=True)
class CacheEntry:
    """The content of one entry."""

    values: dict[str, Any]
    arrays: dict[str, NDArray[np.generic]] = field(default_factory=dict)


def default_folder() -> Path:
    """``$XDG_CACHE_HOME/placerec/evaluations``, by default in ``~/.cache``."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(given) if given else Path.home() / ".cache") / "placerec" / "evaluations"


class EvaluationCache:
    """A folder of entries; with None as folder nothing is cached.

    writable: turns False when an entry could not be written; the run goes on without it.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder, self.writable = folder, True

    def load(self, key: str) -> CacheEntry | None:
        """The entry of a key; None if it is absent or damaged."""
        if self.folder is None:
            return None
        try:
            content = self._file(key).read_bytes()
        except OSError:
            return None
        digest, data = content[:DIGEST_BYTES], content[DIGEST_BYTES:]
        if hashlib.sha256(data).digest() != digest:
            return None
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return CacheEntry(json.loads(arrays.pop(VALUES).tobytes()), arrays)

    def store(self, key: str, entry: CacheEntry) -> None:
        """Write an entry, whole or not at all."""
        if self.folder is None:
            return
        buffer = io.BytesIO()
        text = np.frombuffer(canonical_json(entry.values).encode(), np.uint8)
        np.savez(buffer, allow_pickle=False, **{VALUES: text}, **entry.arrays)
        data = buffer.getvalue()
        # Two evaluations may store the same entry at the same time, so each writes a file of its own.
        partial = self.folder / f"{key}.{secrets.token_hex(4)}.tmp"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with replacing(self._file(key), partial, durable=False):
                partial.write_bytes(hashlib.sha256(data).digest() + data)
        except OSError:
            self.writable = False

    def _file(self, key: str) -> Path:
        assert self.folder is not None
        return self.folder / f"{key}.evaluation"


def cache_key(**parts: Any) -> str:
    """SHA-256 over ``parts`` (JSON), the code that computes figures, and the versions of its libraries."""
    return json_digest({"format": FORMAT, "code": code_digest(), "libraries": _libraries(), **parts})


@cache
def code_digest() -> str:
    """SHA-256 over the modules of ``core`` and ``lab`` that can change a figure."""
    root = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for path in sorted(path for package in ("core", "lab") for path in (root / package).rglob("*.py")):
        name = path.relative_to(root).as_posix()
        if not name.startswith(NOT_COMPUTING):
            digest.update(f"{name} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return digest.hexdigest()


def files_digest(paths: Sequence[Path]) -> str:
    """SHA-256 over the contents of files in their order, without their names.

    Raises:
        InvalidTraverse: one cannot be read.
    """
    return json_digest([_file_digest(path) for path in paths])


def arrays_digest(arrays: Sequence[NDArray[np.int64]]) -> str:
    """SHA-256 over lists of indices, such as a truth."""
    return json_digest([array.tolist() for array in arrays])


@cache
def _file_digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InvalidTraverse(f"{path} cannot be read: {error.strerror}.") from error


@cache
def _libraries() -> Mapping[str, str]:
    return {name: version(name) for name in LIBRARIES}
