"""Benchmark data sets, ready to be pointed at a folder: traverses, order, truth, reduced references.

Names, sizes and tolerances are those of the thesis (section 2.4, Tables 2.2 and 2.3); folder names
are those under which its authors and VPR-Bench hand the sets out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from core.errors import InvalidGroundTruth, InvalidTraverse
from core.evaluation.data.pairs import TraversePair, all_references, count_negatives, leave_run_out
from core.evaluation.data.poses import nearest_truth, read_poses, within_truth
from core.frames.traverses import Truth, find_images, read_ground_truth, tolerance_truth

TRUTH_FILE = "ground_truth.csv"

Rule = Callable[[Sequence[Path], Sequence[Path]], Truth]
"""Truth from the images of queries and references, in that order."""


@dataclass(frozen=True)
class Sizes:
    """T, R, and with reduced references T' and R' (Table 2.2)."""

    queries: int
    references: int
    answerable: int | None = None
    kept: int | None = None


@dataclass(frozen=True)
class Dataset:
    """One data set.

    references, queries: names that the folder of a traverse goes by; the first that is there is taken.
    rule: what is true where no ``ground_truth.csv`` lies beside the traverses; None where one must.
    truth: the rule, in words.
    sizes: those of the thesis; None where it has none.
    """

    name: str
    title: str
    references: tuple[str, ...]
    queries: tuple[str, ...]
    truth: str
    rule: Rule | None = None
    sizes: Sizes | None = None


def frames(tolerance: int) -> Rule:
    """Query i is true at the references i - ``tolerance`` to i + ``tolerance``."""
    return lambda queries, references: tolerance_truth(len(queries), len(references), tolerance)


def nearest(tolerance: int) -> Rule:
    """A query is true at the reference nearest to its geotag and ``tolerance`` frames around that."""
    return lambda queries, references: nearest_truth(read_poses(queries), read_poses(references), tolerance)


def within(metres: float) -> Rule:
    """A query is true at the references within ``metres`` of its position."""
    return lambda queries, references: within_truth(read_poses(queries), read_poses(references), metres, None)


def groups(queries: Sequence[Path], references: Sequence[Path]) -> Truth:
    """Query i is true at the i-th group of references, all groups of one size.

    Raises:
        InvalidTraverse: the references cannot be shared out evenly.
    """
    size, rest = divmod(len(references), len(queries))
    if rest or not size:
        raise InvalidTraverse(
            f"{len(references)} references cannot be shared out evenly over {len(queries)} queries: some are missing."
        )
    return [np.arange(index * size, (index + 1) * size, dtype=np.int64) for index in range(len(queries))]


def _berlin(name: str, title: str, folder: str, known: int, asked: int, sizes: Sizes) -> Dataset:
    return Dataset(
        name,
        title,
        (f"{folder}_{known}", "reference", "ref"),
        (f"{folder}_{asked}", "query"),
        "the reference nearest to the query's geotag, ±2 frames",
        nearest(2),
        sizes,
    )


DATASETS: tuple[Dataset, ...] = (
    Dataset(
        "gardens-point",
        "Gardens Point Walking",
        ("night_right", "reference", "ref"),
        ("day_left", "query"),
        "±3 frames",
        frames(3),
        Sizes(200, 200, 152, 150),
    ),
    Dataset(
        "synthesized-nordland",
        "Synthesized Nordland",
        ("summer", "summer_ref", "reference", "ref"),
        ("winter", "winter_test", "query"),
        "±2 frames",
        frames(2),
        Sizes(1622, 1622, 1221, 1217),
    ),
    Dataset(
        "nordland",
        "Nordland",
        ("summer", "reference", "ref"),
        ("winter", "query"),
        "±2 frames",
        frames(2),
    ),
    Dataset(
        "st-lucia",
        "St Lucia",
        ("190809_0845_Ref", "190809_0845_ref", "190809_0845", "reference", "ref"),
        ("100909_1410_Test", "100909_1410_test", "100909_1410", "query"),
        "within 25 m by GPS (the distance is ours: the thesis names none)",
        within(25.0),
        Sizes(1249, 1249),
    ),
    Dataset(
        "spedtest",
        "SPEDTest",
        ("refer", "reference", "ref"),
        ("query",),
        "the i-th three references (in VPR-Bench's form the i-th one)",
        groups,
        Sizes(607, 1821),
    ),
    _berlin("berlin-a100", "Berlin A100", "berlin_A100", 2, 1, Sizes(81, 85, 70, 64)),
    _berlin(
        "berlin-halenseestrasse",
        "Berlin Halenseestrasse",
        "berlin_halenseestrasse",
        2,
        1,
        Sizes(67, 157, 50, 138),
    ),
    _berlin("berlin-kudamm", "Berlin Kudamm", "berlin_kudamm", 1, 2, Sizes(222, 201, 166, 151)),
    Dataset(
        "tokyo247",
        "Tokyo 24/7 (Query247)",
        ("database", "reference", "ref"),
        ("queries", "query"),
        "within 25 m of the query",
        within(25.0),
    ),
    Dataset(
        "corridor",
        "Corridor",
        ("ref", "reference"),
        ("query",),
        f"the rows of {TRUTH_FILE}",
    ),
    Dataset(
        "lip6",
        "Lip6 outdoor",
        ("reference", "ref"),
        ("query",),
        f"the rows of {TRUTH_FILE}",
    ),
)


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
        folder: holds the folders of the traverses.
        reduced: leave references out until Table 2.2's R' are kept; ``seed`` draws which.

    Raises:
        InvalidTraverse: a folder is missing or empty, or has another size than the reduced references are for.
        InvalidGroundTruth: the file or the poses that say what is true are missing or malformed.
    """
    references = find_images(_traverse(dataset, folder, dataset.references, "references"))
    queries = find_images(_traverse(dataset, folder, dataset.queries, "queries"))
    truth = _truth(dataset, folder, queries, references)
    notes = _size_notes(dataset, queries, references)
    if not reduced:
        return TraversePair(dataset.title, references, queries, truth, all_references(references), notes)
    answerable, keep = _reduced_sizes(dataset, queries, references)
    kept = leave_run_out(truth, len(references), keep, answerable, seed)
    left = len(queries) - count_negatives(truth, kept)
    notes.append(
        f"{keep} of {len(references)} references are kept, and {left} queries keep a true one (Table 2.2: {keep} and "
        f"{answerable}): one contiguous run is left out. The table gives counts only; which run is our choice, drawn "
        f"with the seed {seed}."
    )
    return TraversePair(dataset.title, references, queries, truth, kept, notes)


def _traverse(dataset: Dataset, folder: Path, names: tuple[str, ...], what: str) -> Path:
    for name in names:
        if (folder / name).is_dir():
            return folder / name
    others = f" (or {', '.join(names[1:])} in its place)" if names[1:] else ""
    raise InvalidTraverse(f"{dataset.title}: its {what} are expected in the folder {folder / names[0]}{others}.")


def _truth(dataset: Dataset, folder: Path, queries: Sequence[Path], references: Sequence[Path]) -> Truth:
    path = folder / TRUTH_FILE
    if path.is_file():
        return read_ground_truth(path, len(queries), len(references))
    if dataset.rule is None:
        raise InvalidGroundTruth(
            f"{dataset.title}: its truth is expected in the file {path}, with rows query,reference."
        )
    try:
        return dataset.rule(queries, references)
    except InvalidGroundTruth as error:
        raise InvalidGroundTruth(
            f"{dataset.title}: {error} Or put its truth into {path}, with rows query,reference."
        ) from error


def _size_notes(dataset: Dataset, queries: Sequence[Path], references: Sequence[Path]) -> list[str]:
    sizes = dataset.sizes
    if sizes is None or (sizes.queries, sizes.references) == (len(queries), len(references)):
        return []
    return [
        f"The thesis counts {sizes.queries} queries and {sizes.references} references of {dataset.title}; here are "
        f"{len(queries)} and {len(references)}, so its figures do not compare."
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
