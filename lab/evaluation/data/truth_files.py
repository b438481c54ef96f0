"""Published files that say what is true: VPR-Bench's arrays, tables with a row a query, MATLAB's matrices.

Each reader takes the file and the images of queries and references, and gives the truth.  A number in a file is an
index from 0, or, where all images are named by numbers and those of the file are among them, the name of an image.
"""

from __future__ import annotations

import csv
import re
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidGroundTruth, InvalidModel
from core.frames.traverses import Truth
from lab.conversion.matfiles import read_mat
from lab.evaluation.data.object_arrays import Array, read_object_array

Reader = Callable[[Path, Sequence[Path], Sequence[Path]], Truth]

MAX_REFERENCES = 50_000_000
"""True references of all queries together."""

INDEX = r"[0-9]{1,9}"

MAX_UNPACKED = 2**30
"""Bytes of a ``.npz`` file's arrays."""


def read_array(path: Path, queries: Sequence[Path], references: Sequence[Path]) -> Truth:
    """A ``.npy`` file as VPR-Bench, AnyLoc and GSV-Cities keep it, of objects or of numbers.

    A row is a query and the list of its references, or the references alone.  References beyond the traverse, which
    the lists of some frames at its end name, do not count.

    Raises:
        InvalidGroundTruth: the file is no such list, or of another number of queries.
    """
    rows = _rows(path)
    pairs = all(len(row) == 2 and _is_number(row[0]) for row in rows) and any(not _is_number(row[1]) for row in rows)
    found: list[set[int]] = [set() for _ in queries]
    total = 0
    for position, row in enumerate(rows):
        numbers = _whole(row[1] if pairs else row, path)
        total += len(numbers)
        if total > MAX_REFERENCES:
            raise InvalidGroundTruth(f"{path.name} lists more than {MAX_REFERENCES} true references.")
        query = _whole(row[0], path)[0] if pairs else position
        if not 0 <= query < len(queries):
            raise _other_count(path, "query", query, len(queries))
        found[query].update(number for number in numbers if 0 <= number < len(references))
    if len(rows) < len(queries):
        raise InvalidGroundTruth(f"{path.name} has {len(rows)} rows, and there are {len(queries)} queries.")
    return _truth(path, found)


def read_table(query: int, reference: int, tolerance: int) -> Reader:
    """A reader of a CSV table with a row a query.

    Args:
        query, reference: columns of the numbers of the query and of its reference; from the end where below 0.
        tolerance: frames before and after the reference that are true, too.
    """

    def read(path: Path, queries: Sequence[Path], references: Sequence[Path]) -> Truth:
        rows = []
        for place, (number, cells) in enumerate(_table(path)):
            if len(cells) <= max(query, reference, -1 - query, -1 - reference):
                raise InvalidGroundTruth(f"{path.name}, line {number}: there are {len(cells)} columns.")
            pair = cells[query], cells[reference]
            if place == 0 and not all(re.fullmatch(INDEX, cell) for cell in pair):
                continue  # the heading
            rows.append([_index(cell, path, number) for cell in pair])
        queried = _positions([row[0] for row in rows], queries, path, "query")
        known = _positions([row[1] for row in rows], references, path, "reference")
        found: list[set[int]] = [set() for _ in queries]
        for one, true in zip(queried, known, strict=True):
            found[one].update(range(max(0, true - tolerance), min(len(references), true + tolerance + 1)))
        return _truth(path, found)

    return read


def read_matrix(path: Path, queries: Sequence[Path], references: Sequence[Path]) -> Truth:
    """A MATLAB file: a matrix of zeros and ones, queries by references or turned, or lists of numbers.

    Rows of numbers are the references of each query, or where there are two columns and the first counts the queries,
    a query and a reference.  They count from 1, and 0 fills up, unless 0 is there once, as of lists that count from 0.

    Raises:
        InvalidGroundTruth: the file cannot be read, or holds no matrix of this many queries.
    """
    try:
        variables = read_mat(path)
    except InvalidModel as error:
        raise InvalidGroundTruth(f"The truth cannot be read: {error}") from error
    return truth_of_variables(variables, path, len(queries), len(references))


def truth_of_variables(variables: Mapping[str, Any], path: Path, queries: int, references: int) -> Truth:
    """The truth of the first variable of a MATLAB file that fits the numbers of queries and references.

    Raises:
        InvalidGroundTruth: none fits.
    """
    for value in variables.values():
        if isinstance(value, list) and len(value) == queries:
            return _of_cell(value, path, references)
        if isinstance(value, np.ndarray) and value.ndim == 2 and {queries, references} & set(value.shape):
            return _of_matrix(np.asarray(value, np.float64), path, queries, references)
    held = ", ".join(f"{name} {getattr(value, 'shape', '')}".strip() for name, value in list(variables.items())[:8])
    raise InvalidGroundTruth(
        f"{path.name} holds no matrix for {queries} queries and {references} references, only {held or 'nothing'}."
    )


def read_masks(path: Path, queries: Sequence[Path], references: Sequence[Path]) -> tuple[Truth, Truth]:
    """VPR_Tutorial's ``GT.npz``: matrices references by queries, ``GThard`` of what is true, ``GTsoft`` of what may be.

    Returns:
        The truth, and the references that a query is not matched against: those of ``GTsoft`` alone.

    Raises:
        InvalidGroundTruth: the file cannot be read, or has matrices of another shape.
    """
    hard, soft = (_mask(path, name, (len(references), len(queries))) for name in ("GThard", "GTsoft"))
    return _columns(hard), _columns(soft & ~hard)


def read_positions(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Patch-NetVLAD's ``.npz``: positions of queries and references, [n, 2] in metres or frames, and the distance.

    Raises:
        InvalidGroundTruth: the file cannot be read, or lacks one of them.
    """
    queried, known = (np.asarray(_member(path, name), np.float64) for name in ("utmQ", "utmDb"))
    distance = np.asarray(_member(path, "posDistThr"), np.float64)
    if any(one.ndim != 2 or one.shape[1] != 2 or not np.isfinite(one).all() for one in (queried, known)):
        raise InvalidGroundTruth(f"{path.name}: utmQ and utmDb are not rows of two finite numbers.")
    if distance.size != 1 or not np.isfinite(distance).all():
        raise InvalidGroundTruth(f"{path.name}: posDistThr is not a distance.")
    return queried, known, float(distance.ravel()[0])


def _rows(path: Path) -> list[Any]:
    try:
        numbers = np.load(path, allow_pickle=False, mmap_mode="r")
    except OSError as error:
        raise InvalidGroundTruth(f"{path} cannot be read: {error.strerror or 'it is no .npy file'}.") from error
    except (ValueError, EOFError, SyntaxError, tokenize.TokenError):  # of objects, or damaged
        return _object_rows(read_object_array(path), path)
    if not isinstance(numbers, np.ndarray) or numbers.ndim not in (1, 2) or numbers.dtype.kind not in "iuf":
        raise InvalidGroundTruth(f"{path.name} holds no rows of numbers.")
    if numbers.size > MAX_REFERENCES:
        raise InvalidGroundTruth(f"{path.name} lists more than {MAX_REFERENCES} true references.")
    return [row if isinstance(row, list) else [row] for row in numbers.tolist()]


def _object_rows(found: Array, path: Path) -> list[Any]:
    if len(found.shape) == 1:
        return [_list(item) for item in found.items]
    if len(found.shape) == 2:
        width = found.shape[1]
        return [list(found.items[start : start + width]) for start in range(0, len(found.items), max(1, width))]
    raise InvalidGroundTruth(f"{path.name} holds an array of {len(found.shape)} dimensions, not a row a query.")


def _list(item: Any) -> Any:
    match item:
        case Array():
            return list(item.items)
        case list() | tuple():
            return list(item)
        case _:
            return [item]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _whole(value: Any, path: Path) -> list[int]:
    """One number or a list of them."""
    values = _list(value)
    if not all(_is_number(one) and float(one).is_integer() for one in values):
        raise InvalidGroundTruth(f"{path.name}: a list of references holds something that is no whole number.")
    return [int(one) for one in values]


def _table(path: Path) -> Iterator[tuple[int, list[str]]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, skipinitialspace=True)
            for cells in reader:
                row = [cell.strip() for cell in cells]
                while row and not row[-1]:
                    row.pop()
                if row:
                    yield reader.line_num, row
    except OSError as error:
        raise InvalidGroundTruth(f"{path} cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidGroundTruth(f"{path} is not a CSV file in UTF-8: {error}.") from error


def _index(text: str, path: Path, line: int) -> int:
    if not re.fullmatch(INDEX, text):
        raise InvalidGroundTruth(f"{path.name}, line {line}: {text[:80]!r} is not the number of an image.")
    return int(text)


def _positions(numbers: Sequence[int], images: Sequence[Path], path: Path, what: str) -> list[int]:
    """Where the images of these numbers stand: by their names where those are numbers, else by their order."""
    names = {int(image.stem): index for index, image in enumerate(images) if image.stem.isdecimal()}
    if len(names) == len(images) and names.keys() >= set(numbers):
        return [names[number] for number in numbers]
    for number in numbers:
        if number >= len(images):
            raise _other_count(path, what, number, len(images))
    return list(numbers)


def _other_count(path: Path, what: str, number: int, count: int) -> InvalidGroundTruth:
    return InvalidGroundTruth(
        f"{path.name} names the {what} {number}, and {count} images are there: some are missing, or the file belongs "
        "to other traverses."
    )


def _of_matrix(matrix: NDArray[np.float64], path: Path, queries: int, references: int) -> Truth:
    if not np.isfinite(matrix).all():
        raise InvalidGroundTruth(f"{path.name} holds numbers that are not finite.")
    if set(np.unique(matrix)) <= {0.0, 1.0} and matrix.shape in ((queries, references), (references, queries)):
        turned = matrix.shape != (queries, references)
        return _truth(path, [set(true.tolist()) for true in _columns((matrix if turned else matrix.T) > 0)])
    rows = matrix if len(matrix) == queries else matrix.T
    if len(rows) != queries or (rows < 0).any() or (rows != np.round(rows)).any():
        raise InvalidGroundTruth(f"{path.name} holds no row of whole numbers for each of {queries} queries.")
    if rows.shape[1] == 2 and np.array_equal(np.sort(rows[:, 0]), np.arange(1, queries + 1)):
        order = np.argsort(rows[:, 0])
        rows = rows[order, 1:]
    return _of_rows([row.tolist() for row in rows], path, references)


def _of_cell(cell: list[Any], path: Path, references: int) -> Truth:
    if not all(isinstance(item, np.ndarray) and item.dtype.kind in "iuf" for item in cell):
        raise InvalidGroundTruth(f"{path.name} holds a cell of something other than numbers.")
    rows = [np.asarray(item, np.float64).ravel() for item in cell]
    if any((~np.isfinite(row)).any() or (row < 0).any() or (row != np.round(row)).any() for row in rows):
        raise InvalidGroundTruth(f"{path.name} holds a cell of something other than whole numbers.")
    return _of_rows([row.tolist() for row in rows], path, references)


def _of_rows(rows: Sequence[Sequence[float]], path: Path, references: int) -> Truth:
    """Numbers of references, from 1 or, where 0 is there once, from 0."""
    numbers = [int(number) for row in rows for number in row]
    first = 0 if numbers.count(0) == 1 and max(numbers) < references else 1
    if numbers and max(numbers) >= references + first:
        raise _other_count(path, "reference", max(numbers), references)
    return _truth(path, [{int(number) - first for number in row if number >= first} for row in rows])


def _columns(mask: NDArray[np.bool_]) -> Truth:
    """The indices that are set in each column."""
    return [np.flatnonzero(column).astype(np.int64) for column in mask.T]


def _mask(path: Path, name: str, shape: tuple[int, int]) -> NDArray[np.bool_]:
    values = _member(path, name)
    if values.shape != shape or values.dtype.kind not in "biuf":
        raise InvalidGroundTruth(
            f"{path.name}: {name} has the shape {values.shape}; {shape[0]} references and {shape[1]} queries are here."
        )
    return values.astype(np.bool_)


def _member(path: Path, name: str) -> NDArray[Any]:
    try:
        with np.load(path, allow_pickle=False) as file:
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise InvalidGroundTruth(f"{path.name} is not a .npz file.")
            if file.zip is None or sum(entry.file_size for entry in file.zip.infolist()) > MAX_UNPACKED:
                raise InvalidGroundTruth(f"{path.name} would unpack to more than {MAX_UNPACKED} bytes.")
            return np.asarray(file[name])
    except OSError as error:
        raise InvalidGroundTruth(f"{path} cannot be read: {error.strerror or 'it is no .npz file'}.") from error
    except KeyError:
        raise InvalidGroundTruth(f"{path.name} holds no {name}.") from None
    except (ValueError, EOFError, SyntaxError, tokenize.TokenError, zipfile.BadZipFile, zlib.error) as error:
        raise InvalidGroundTruth(f"{path.name} is not a .npz file of plain numbers.") from error


def _truth(path: Path, found: Sequence[set[int]]) -> Truth:
    if not any(found):
        raise InvalidGroundTruth(f"{path.name} names no true reference.")
    return [np.array(sorted(true), np.int64) for true in found]
