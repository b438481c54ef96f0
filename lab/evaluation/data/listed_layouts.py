"""Layouts whose images stand in lists: MATLAB's dbStruct, Patch-NetVLAD's and GSV-Cities' lists, Mapillary's tables."""

from __future__ import annotations

import csv
import tokenize
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.errors import InvalidGroundTruth, InvalidModel, InvalidTraverse
from core.frames.traverses import Truth
from lab.conversion.matfiles import read_mat
from lab.evaluation.data.layouts import DatasetLayout, LayoutTraverses, Names, existing, located, present
from lab.evaluation.data.poses import near
from lab.evaluation.data.truth_files import read_array, read_positions


def dbstruct(home: str, files: Names, references: Names, queries: Names) -> DatasetLayout:
    """A ``.mat`` file with a structure dbStruct, as NetVLAD's authors hand out Pittsburgh and Tokyo 24/7.

    Args:
        files: the file, from ``home`` on.
        references, queries: folders from which its names of images count; "." is ``home``.
    """

    def read(base: Path) -> LayoutTraverses:
        path = present(base, files)
        assert path is not None, "found"
        fields = _fields(path)
        known, queried = (_text(fields, names, path) for names in (("dbImageFns", "dbImage"), ("qImageFns", "qImage")))
        at_known = _positions(fields, ("utmDb", "locDb"), len(known), path)
        at_queried = _positions(fields, ("utmQ", "locQ"), len(queried), path)
        metres = _scalar(fields, "posDistThr", path)
        return LayoutTraverses(
            existing(_root(base, references, known[0]), known, path),
            existing(_root(base, queries, queried[0]), queried, path),
            near(at_queried, at_known, metres)[0],
        )

    return DatasetLayout("NetVLAD's dbStruct", home, (files,), read, files[0])


def patch_netvlad(name: str, truth: str = "") -> DatasetLayout:
    """Patch-NetVLAD's lists of images (Hausler et al., CVPR 2021), beside the data sets that they name.

    Args:
        truth: name of its file of positions; empty where a rule says what is true.
    """
    lists = [
        (f"dataset_imagenames/{name}_imageNames_{side}.txt", f"{name}_imageNames_{side}.txt")
        for side in ("index", "query")
    ]
    positions = (f"dataset_gt_files/{truth}.npz", f"{truth}.npz")

    def read(base: Path) -> LayoutTraverses:
        known, queried = (_listed_images(base, names) for names in lists)
        if not truth:
            return LayoutTraverses(known, queried)
        path = present(base, positions)
        assert path is not None, "found"
        at_queried, at_known, distance = read_positions(path)
        for images, positions_of, what in ((queried, at_queried, "queries"), (known, at_known, "references")):
            if len(images) != len(positions_of):
                raise InvalidGroundTruth(f"{path.name} has {len(positions_of)} {what}, and the list {len(images)}.")
        return LayoutTraverses(known, queried, near(at_queried, at_known, distance)[0])

    held = (*lists, positions) if truth else tuple(lists)
    return DatasetLayout("Patch-NetVLAD", "", held, read, positions[0] if truth else "")


def gsv_cities(home: str, stem: str, truths: Names) -> DatasetLayout:
    """GSV-Cities' lists (Ali-bey et al., 2022): the names of references and queries, and what is true of each query."""
    lists = [(f"{stem}_{side}Images.npy", f"{home.split('/')[-1]}/{stem}_{side}Images.npy") for side in ("db", "q")]

    def read(base: Path) -> LayoutTraverses:
        known, queried = (_names(present(base, names)) for names in lists)
        chosen = present(base, (f"{stem}_qIdx.npy",))
        if chosen is not None:
            queried = [queried[int(index)] for index in _whole(chosen, len(queried))]
        references, queries = (existing(base, names, base / lists[0][0]) for names in (known, queried))
        path = present(base, truths)
        assert path is not None, "found"
        return LayoutTraverses(references, queries, read_array(path, queries, references))

    return DatasetLayout("GSV-Cities", home, (*lists, truths), read, truths[0])


def mapillary(cities: Names, metres: float) -> DatasetLayout:
    """Mapillary Street-Level Sequences as they are downloaded: tables of each city's queries and database.

    As its authors evaluate: no panoramas, the images of the subtask ``all``, true within ``metres``, and without the
    queries that have no true reference.
    """

    def read(base: Path) -> LayoutTraverses:
        known: list[Path] = []
        queried: list[Path] = []
        truth: Truth = []
        for city in cities:
            references, at_references = _city(base / city / "database")
            queries, at_queries = _city(base / city / "query")
            found, _ = near(at_queries, at_references, metres)
            answerable = [index for index, true in enumerate(found) if len(true)]
            truth += [found[index] + len(known) for index in answerable]
            queried += [queries[index] for index in answerable]
            known += references
        if not queried:
            raise InvalidGroundTruth(f"{base}: no query lies within {metres:g} m of a reference.")
        return LayoutTraverses(known, queried, truth)

    held = tuple((f"{city}/{side}/postprocessed.csv",) for city in cities for side in ("query", "database"))
    return DatasetLayout("Mapillary", "mapillary_sls/train_val", held, read)


def _city(folder: Path) -> tuple[list[Path], NDArray[np.float64]]:
    """Images of one side of a city, and their positions, float64 [n, 2] in metres."""
    rows = _csv(folder / "postprocessed.csv")
    raw = {row.get("key"): row for row in _csv(folder / "raw.csv")}
    subtasks = [row.get("all", "True") for row in _csv(folder / "subtask_index.csv")] or ["True"] * len(rows)
    if len(subtasks) != len(rows):
        raise InvalidGroundTruth(
            f"{folder}: postprocessed.csv has {len(rows)} rows, subtask_index.csv {len(subtasks)}."
        )
    names, positions = [], []
    for number, (row, chosen) in enumerate(zip(rows, subtasks, strict=True), start=2):
        if chosen != "True" or raw.get(row.get("key"), {}).get("pano", "False") == "True":
            continue
        try:
            positions.append([float(row["easting"]), float(row["northing"])])
            names.append(f"images/{row['key']}.jpg")
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidGroundTruth(
                f"{folder / 'postprocessed.csv'}, line {number}: key, easting and northing are needed."
            ) from error
    table = np.array(positions, np.float64).reshape(-1, 2)
    if not np.isfinite(table).all():
        raise InvalidGroundTruth(f"{folder / 'postprocessed.csv'}: a position is not finite.")
    return existing(folder, names, folder / "postprocessed.csv"), table


def _csv(path: Path) -> list[dict[str, str]]:
    """The rows of a table with a heading; none where ``subtask_index.csv`` is not there."""
    if path.name == "subtask_index.csv" and not path.exists():
        return []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            return list(csv.DictReader(file))
    except OSError as error:
        raise InvalidGroundTruth(f"{path} cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidGroundTruth(f"{path} is not a CSV file in UTF-8: {error}.") from error


def _listed_images(base: Path, names: Names) -> list[Path]:
    path = present(base, names)
    assert path is not None, "found"
    return existing(base, path.read_text("utf-8", "replace").splitlines(), path)


def _names(path: Path | None) -> list[str]:
    assert path is not None, "found"
    values = _plain_array(path)
    if values.ndim != 1 or values.dtype.kind != "U":
        raise InvalidTraverse(f"{path.name} holds no names of images.")
    return [str(name).replace("\\", "/") for name in values]


def _whole(path: Path, count: int) -> NDArray[np.int64]:
    values = _plain_array(path)
    if (
        values.ndim != 1
        or values.dtype.kind not in "iu"
        or (values.size and not 0 <= values.min() <= values.max() < count)
    ):
        raise InvalidTraverse(f"{path.name} holds no indices of {count} queries.")
    return values.astype(np.int64)


def _plain_array(path: Path) -> NDArray[Any]:
    try:
        return np.asarray(np.load(path, allow_pickle=False))
    except OSError as error:
        raise InvalidTraverse(f"{path} cannot be read: {error.strerror or 'it is no .npy file'}.") from error
    except (ValueError, EOFError, SyntaxError, tokenize.TokenError) as error:
        raise InvalidTraverse(f"{path.name} is not a plain .npy array.") from error


def _fields(path: Path) -> dict[str, Any]:
    try:
        found = read_mat(path).get("dbStruct")
    except InvalidModel as error:
        raise InvalidGroundTruth(f"The truth cannot be read: {error}") from error
    if not isinstance(found, dict):
        raise InvalidGroundTruth(f"{path.name} holds no structure dbStruct.")
    return found


def _field(fields: dict[str, Any], names: Names, path: Path) -> Any:
    for name in names:
        if name in fields:
            return fields[name]
    raise InvalidGroundTruth(f"{path.name}: dbStruct has no {names[0]}, only {', '.join(list(fields)[:20])}.")


def _text(fields: dict[str, Any], names: Names, path: Path) -> list[str]:
    """Names of images: a cell of texts, or rows of characters filled up with spaces."""
    value = _field(fields, names, path)
    found = value.split("\n") if isinstance(value, str) else value
    if not isinstance(found, list) or not found or not all(isinstance(one, str) for one in found):
        raise InvalidGroundTruth(f"{path.name}: {names[0]} of dbStruct holds no names of images.")
    return [one.strip() for one in found]


def _positions(fields: dict[str, Any], names: Names, count: int, path: Path) -> NDArray[np.float64]:
    """Metres, float64 [count, 2]; the files have them turned."""
    value = np.asarray(_field(fields, names, path))
    if value.ndim == 2 and value.dtype.kind in "fiu":
        table = np.asarray(value.T if value.shape == (2, count) else value, np.float64)
        if table.shape == (count, 2) and np.isfinite(table).all():
            return table
    raise InvalidGroundTruth(
        f"{path.name}: {names[0]} of dbStruct is not 2 x {count} finite metres, for {count} images; it has the shape "
        f"{value.shape}."
    )


def _scalar(fields: dict[str, Any], name: str, path: Path) -> float:
    value = np.asarray(_field(fields, (name,), path))
    if value.size != 1 or value.dtype.kind not in "fiu" or not np.isfinite(value).all() or value.item() < 0:
        raise InvalidGroundTruth(f"{path.name}: {name} of dbStruct is not a distance.")
    return float(value.item())


def _root(base: Path, names: Names, first: str) -> Path:
    """The folder that the names of images count from: the first that holds the first image, else the first."""
    roots = [base / name for name in names]
    return next((root for root in roots if located(root, first) is not None), roots[0])
