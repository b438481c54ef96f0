"""Traverses on disk: the images of a directory in order, and the ground truth between two traverses."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidGroundTruth, InvalidTraverse

Truth = list[NDArray[np.int64]]
"""For each query the indices of its true references, ascending; there may be none."""

SUPPORTED_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp"})
CONVERTED_SUFFIXES = frozenset(
    {".avif", ".bmp", ".dib", ".gif", ".jp2", ".jpe", ".pam", ".pbm", ".pgm", ".pnm", ".ppm", ".ras", ".sr", ".tif"}
    | {".tiff"}
)
"""Formats that become PNG on the way."""
OTHER_SUFFIXES = CONVERTED_SUFFIXES | {".exr", ".hdr", ".heic", ".pfm", ".pic"}
"""These, and formats that are refused by name.

Images that cannot be decoded are listed, too: if they were skipped, every index after them would shift.
"""


def natural_key(name: str) -> tuple[list[str | int], str]:
    """A sort key by which ``2.jpg`` comes before ``10.jpg``; equal numbers are sorted by their spelling."""
    parts = re.split(r"([0-9]+)", name)
    return [int(part) if index % 2 else part for index, part in enumerate(parts)], name


def find_images(directory: Path) -> list[Path]:
    """The images of a directory in natural order, without hidden files and those of subfolders.

    Raises:
        InvalidTraverse: the directory does not exist, cannot be read, or has no image.
    """
    images, _ = _entries(directory)
    _check_not_empty(images, directory)
    return sorted(images, key=lambda path: natural_key(path.name))


def find_images_below(directory: Path) -> list[Path]:
    """The images of a directory and of all folders below it in natural order, without hidden ones.

    Raises:
        InvalidTraverse: the directory does not exist, a folder cannot be read, or there is no image.
    """
    found, folders = _entries(directory)
    while folders:
        images, deeper = _entries(folders.pop())
        found, folders = found + images, folders + deeper
    _check_not_empty(found, directory)
    return sorted(found, key=lambda path: [natural_key(part) for part in path.relative_to(directory).parts])


def _entries(directory: Path) -> tuple[list[Path], list[Path]]:
    """The images and the folders of a directory."""
    # Hidden entries are left out, and links to folders, which may form cycles.
    suffixes = SUPPORTED_SUFFIXES | OTHER_SUFFIXES
    try:
        entries = [path for path in directory.iterdir() if not path.name.startswith(".")]
        images = [path for path in entries if path.suffix.lower() in suffixes and path.is_file()]
        folders = [path for path in entries if path.is_dir() and not path.is_symlink()]
    except OSError as error:
        raise InvalidTraverse(f"{directory} cannot be read as a directory: {error.strerror}.") from error
    return images, folders


def _check_not_empty(images: list[Path], directory: Path) -> None:
    if not images:
        read = ", ".join([*sorted(SUPPORTED_SUFFIXES), *sorted(CONVERTED_SUFFIXES)])
        raise InvalidTraverse(f"{directory} holds no image ({read}).")


def tolerance_truth(queries: int, references: int, tolerance: int) -> Truth:
    """The ground truth of aligned traverses: query i matches the references i - ``tolerance`` to i + ``tolerance``."""
    return [
        np.arange(max(0, query - tolerance), min(references, query + tolerance + 1), dtype=np.int64)
        for query in range(queries)
    ]


def read_ground_truth(path: Path, queries: int, references: int) -> Truth:
    """Read the true references from a CSV file with rows ``query,reference``; a query may have several rows.

    A header with these two names may come first; indices count from 0.

    Raises:
        InvalidGroundTruth: the file cannot be read, a row is malformed, or an index is out of range.
    """
    found: list[set[int]] = [set() for _ in range(queries)]
    for number, line in _lines(path):
        row = [field.strip() for field in next(csv.reader([line]))]
        if number == 1 and [field.lower() for field in row] == ["query", "reference"]:
            continue
        if len(row) != 2:
            raise InvalidGroundTruth(f"{path.name}, line {number}: a row is 'query,reference', not {line[:80]!r}.")
        query = _index(row[0], queries, "query", path, number)
        found[query].add(_index(row[1], references, "reference", path, number))
    if not any(found):
        raise InvalidGroundTruth(f"{path.name} names no true reference.")
    return [np.array(sorted(true), np.int64) for true in found]


def read_retained_references(path: Path, references: int) -> NDArray[np.int64]:
    """Read the indices of the references to retain, one on each line; int64 [R'], ascending.

    Raises:
        InvalidGroundTruth: the file cannot be read, a line is no index, or there is none.
    """
    retained = {_index(line.strip(), references, "reference", path, number) for number, line in _lines(path)}
    if not retained:
        raise InvalidGroundTruth(f"{path.name} lists no reference.")
    return np.array(sorted(retained), np.int64)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines that are not blank, with their numbers from 1."""
    try:
        text = path.read_text("utf-8-sig")
    except OSError as error:
        raise InvalidGroundTruth(f"{path} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise InvalidGroundTruth(f"{path} is not text.") from error
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip():
            yield number, line


def _index(text: str, count: int, what: str, path: Path, number: int) -> int:
    if not re.fullmatch(r"[0-9]{1,18}", text):
        raise InvalidGroundTruth(f"{path.name}, line {number}: {text[:80]!r} is not the index of a {what}.")
    if int(text) >= count:
        raise InvalidGroundTruth(
            f"{path.name}, line {number}: there is no {what} {int(text)}; the {count} images are numbered from 0."
        )
    return int(text)
