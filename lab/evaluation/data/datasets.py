"""Opening a data set by its name: its traverses are found in a folder, checked and counted, and given their truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from core.errors import InvalidGroundTruth, InvalidTraverse
from core.frames.traverses import Truth, read_ground_truth
from lab.evaluation.data.layouts import TRUTH_FILE, DatasetLayout, LayoutTraverses, folders
from lab.evaluation.data.pairs import TraversePair, all_references, count_negatives, leave_run_out
from lab.evaluation.data.presets import DATASETS, Dataset


def find_dataset(name: str) -> Dataset:
    """The data set of a name.

    Raises:
        InvalidTraverse: there is none; the text lists those that there are.
    """
    for dataset in DATASETS:
        if dataset.name == name:
            return dataset
    raise InvalidTraverse(f"there is no data set {name[:80]!r}; there are {', '.join(one.name for one in DATASETS)}.")


def open_dataset(dataset: Dataset, folder: Path, reduced: bool = False, seed: int = 0) -> TraversePair:
    """The traverses of a data set in ``folder``, in natural order, with their truth.

    Args:
        folder: holds the folders of the traverses, or is any folder of a published tree above or around them.
        reduced: leave references out until Table 2.2's R' are retained; ``seed`` draws which.

    Raises:
        InvalidTraverse: a folder or an image is missing, or the traverses have another size than the reduced
            references are for.
        InvalidGroundTruth: the file or the poses that say what is true are missing or malformed.
    """
    layout, base = _find(dataset, folder)
    found = _read(dataset, layout, base)
    queries, references = found.queries, found.references
    truth = _truth(dataset, layout, base, found)
    excluded = found.excluded if dataset.exclude is None else dataset.exclude(queries, references)
    _check_matched(dataset, excluded, references)
    notes = [*_size_notes(dataset, base, queries, references), *found.notes]
    if excluded is not None:
        notes.append(f"A query is not matched against {dataset.excluded}.")
    retained = all_references(references)
    if reduced:
        answerable, keep = _reduced_sizes(dataset, queries, references)
        retained = leave_run_out(truth, len(references), keep, answerable, seed)
        left = len(queries) - count_negatives(truth, retained)
        notes.append(
            f"{keep} of {len(references)} references are retained, and {left} queries have a true one (Table 2.2: "
            f"{keep} and {answerable}): one contiguous run is left out. The table gives counts only; which run is our "
            f"choice, drawn with the seed {seed}."
        )
    return TraversePair(dataset.title, references, queries, truth, retained, notes, excluded, dataset.name)


def _find(dataset: Dataset, folder: Path) -> tuple[DatasetLayout, Path]:
    """The layout in which the data set lies there, and the folder that holds it."""
    plain = () if not dataset.references else (folders("two folders", "", dataset.references, dataset.queries),)
    # The layout with a truth of its own comes before the folders alone.
    layouts = sorted((*dataset.layouts, *plain), key=lambda layout: not layout.truth_file)
    found = [(layout, base) for layout in layouts if (base := layout.find(folder)) is not None]
    for layout, base in found:
        if not layout.truth_file or not layout.optional_truth or any(base.glob(layout.truth_file)):
            return layout, base
    if found:
        return found[0]
    raise InvalidTraverse(_missing(dataset, folder))


def _missing(dataset: Dataset, folder: Path) -> str:
    """The missing files, and where they were looked for."""
    said = f"nothing of it is in the folder {folder}."
    for names, what in ((dataset.references, "references"), (dataset.queries, "queries")):
        if names and not any(path.is_dir() for name in names for path in folder.glob(name)):
            more = f" (or {', '.join(names[1:])} in its place)" if names[1:] else ""
            said = f"its {what} are expected in the folder {folder / names[0]}{more}."
            break
    others = "; ".join(layout.looked_for() for layout in dataset.layouts)
    return f"{dataset.title}: {said}" + (
        f" Also looked for, with or without the folders above: {others}." * bool(others)
    )


def _read(dataset: Dataset, layout: DatasetLayout, base: Path) -> LayoutTraverses:
    try:
        return layout.read(base)
    except InvalidGroundTruth as error:
        if not layout.optional_truth:
            raise InvalidGroundTruth(f"{dataset.title}: {error}") from error
        raise _or_own(dataset, base, error) from error


def _or_own(dataset: Dataset, base: Path, error: InvalidGroundTruth) -> InvalidGroundTruth:
    """The same error with the way out of it."""
    where = base / TRUTH_FILE
    return InvalidGroundTruth(f"{dataset.title}: {error} Or put its truth into {where}, with rows query,reference.")


def _truth(dataset: Dataset, layout: DatasetLayout, base: Path, found: LayoutTraverses) -> Truth:
    path = base / TRUTH_FILE
    if path.is_file():
        return read_ground_truth(path, len(found.queries), len(found.references))
    if found.truth is not None:
        return found.truth
    if dataset.rule is None:
        where = " or ".join(str(base / name) for name in _truth_files(dataset, layout))
        raise InvalidGroundTruth(
            f"{dataset.title}: its truth is expected in the file {path}, with rows query,reference"
            + (f", or in {where}, as published." if where else ".")
        )
    try:
        return dataset.rule(found.queries, found.references)
    except InvalidGroundTruth as error:
        raise _or_own(dataset, base, error) from error


def _truth_files(dataset: Dataset, layout: DatasetLayout) -> list[str]:
    """The files in which publishers keep the truth."""
    return list(dict.fromkeys(one.truth_file for one in (layout, *dataset.layouts) if one.truth_file))


def _check_matched(dataset: Dataset, excluded: Truth | None, references: Sequence[Path]) -> None:
    for query, left_out in enumerate(excluded or []):
        if len(left_out) == len(references):
            raise InvalidTraverse(
                f"{dataset.title}: nothing is left to match query {query} against: {dataset.excluded} do not count, "
                f"and there are {len(references)} images."
            )


def _size_notes(dataset: Dataset, base: Path, queries: Sequence[Path], references: Sequence[Path]) -> list[str]:
    sizes = dataset.sizes
    if sizes is None or (sizes.queries, sizes.references) == (len(queries), len(references)):
        return []
    lacks = [
        f"{wanted - len(images)} {what}"
        for wanted, images, what in ((sizes.queries, queries, "queries"), (sizes.references, references, "references"))
        if wanted > len(images)
    ]
    missing = f" ({' and '.join(lacks)} are missing in {base})" if lacks else ""
    return [
        f"{sizes.source} counts {sizes.queries} queries and {sizes.references} references of {dataset.title}; here are "
        f"{len(queries)} and {len(references)}{missing}, so its figures do not compare."
    ]


def _reduced_sizes(dataset: Dataset, queries: Sequence[Path], references: Sequence[Path]) -> tuple[int, int]:
    """T' and R'."""
    sizes = dataset.sizes
    if sizes is None or sizes.answerable is None or sizes.kept is None:
        raise InvalidTraverse(f"the thesis has no reduced references of {dataset.title}; use --limit-references.")
    if (sizes.queries, sizes.references) != (len(queries), len(references)):
        raise InvalidTraverse(
            f"the reduced references of {dataset.title} are for {sizes.queries} queries and {sizes.references} "
            f"references; here are {len(queries)} and {len(references)}."
        )
    return sizes.answerable, sizes.kept
