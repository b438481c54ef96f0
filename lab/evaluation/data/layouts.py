"""Published ways to lay out a data set: where its images lie, in which order, and which file says what is true.

A layout knows the folders above it, too, so that any folder of a publisher's tree can be given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from os.path import isfile
from pathlib import Path

from core.errors import InvalidTraverse
from core.frames.traverses import Truth, find_images
from lab.evaluation.data.truth_files import Reader, read_array, read_masks, read_matrix, read_table

TRUTH_FILE = "ground_truth.csv"
"""The user's own truth; it comes before every other."""

Names = tuple[str, ...]
"""Names that a file or folder goes by, or patterns of them; the first that is there is taken."""


@dataclass(frozen=True)
class LayoutTraverses:
    """The traverses of a layout.

    truth: of each query; None where a rule has to say it.
    excluded: of each query, references that it is not matched against.
    notes: sentences that a reader of the figures must know.
    """

    references: list[Path]
    queries: list[Path]
    truth: Truth | None = None
    excluded: Truth | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class DatasetLayout:
    """One way to lay out a data set.

    publisher: who hands it out so.
    home: the folders from the top of the tree to the one that holds the files; any of the first may be left out.
    holds: the files that must be there for the layout to be taken.
    read: reads that folder; raises InvalidTraverse or InvalidGroundTruth where something is missing or malformed.
    truth_file: the file that says what is true, where there is one.
    inside: folders below ``home`` that may be given in its place, as may be whatever it holds.
    """

    publisher: str
    home: str
    holds: tuple[Names, ...]
    read: Callable[[Path], LayoutTraverses]
    truth_file: str = ""
    inside: str = ""

    @property
    def optional_truth(self) -> bool:
        """Whether the layout is taken without its file of truth, too."""
        return not any(self.truth_file in names for names in self.holds)

    def find(self, folder: Path) -> Path | None:
        """The folder that holds the files; None where this layout is not there."""
        for base in self._bases(folder):
            if all(present(base, names) for names in self.holds):
                return base
        return None

    def looked_for(self) -> str:
        """The files that were looked for, in words."""
        held = ", ".join(names[0] for names in self.holds)
        return f"{self.home}/{{{held}}} ({self.publisher})" if self.home else f"{{{held}}} ({self.publisher})"

    def _bases(self, folder: Path) -> Iterator[Path]:
        yield folder
        home = Path(self.home).parts
        for start in reversed(range(len(home))):
            yield folder.joinpath(*home[start:])
        below = Path(self.inside).parts
        given = folder.resolve()
        if any(fnmatch(given.name, name) for names in self.holds for name in names if not name.startswith("*")):
            yield given.parent
        for depth in range(1, len(below) + 1):
            if given.parts[-depth:] == below[:depth]:
                yield given.parents[depth - 1]


def present(base: Path, names: Names) -> Path | None:
    """The first of several names that is there."""
    return next((path for name in names for path in sorted(base.glob(name))), None)


def folders(
    publisher: str,
    home: str,
    references: Names,
    queries: Names,
    truth_file: str = "",
    read_truth: Reader | None = None,
    only: str = "",
) -> DatasetLayout:
    """Two folders of images side by side.

    Args:
        truth_file, read_truth: the file that says what is true, and its reader; not read beside the user's own.
        only: a text file with the names of the images that count, one a line, where it is there.
    """

    def read(base: Path) -> LayoutTraverses:
        known, queried = _images(base, references, only), _images(base, queries, only)
        path = present(base, (truth_file,)) if truth_file else None
        if path is None or read_truth is None or (base / TRUTH_FILE).is_file():
            return LayoutTraverses(known, queried)
        return LayoutTraverses(known, queried, read_truth(path, queried, known))

    return DatasetLayout(publisher, home, (references, queries), read, truth_file)


def _images(base: Path, names: Names, only: str) -> list[Path]:
    folder = next((path for name in names for path in sorted(base.glob(name)) if path.is_dir()), None)
    if folder is None:
        raise InvalidTraverse(f"{base / names[0]} is no folder.")
    images = find_images(folder)
    if only and (base / only).is_file():
        listed = set((base / only).read_text("utf-8", "replace").split())
        images = [image for image in images if image.name in listed]
        if not images:
            raise InvalidTraverse(f"{folder} holds none of the images that {base / only} lists.")
    return images


def downloaded(name: str, queries: str = "queries", references: Names = ("database", "gallery")) -> DatasetLayout:
    """As VPR-datasets-downloader (Berton et al., 2022) writes it: positions in the names of the files."""
    return folders("VPR-datasets-downloader", f"datasets/{name}/images/test", references, (queries,))


def group(
    home: str, references: Names, queries: Names, truth_file: str, columns: tuple[int, int] | None = None
) -> DatasetLayout:
    """A folder of the tree in which the thesis's group published its data sets.

    Args:
        columns: of a table in CSV, those of the numbers of the query and of its reference (from the end where below 0),
            which is true with two frames on either side; None: the file of truth is MATLAB's.
    """
    known, queried = (*references, "*_ref*", "*[Rr]ef*"), (*queries, "*_test*", "*[Qq]uery*", "*[Tt]est*")
    reader = read_matrix if columns is None else read_table(*columns, 2)
    return folders("The thesis's group", home, known, queried, truth_file, reader)


def vpr_bench(name: str, own_truth: bool = False) -> DatasetLayout:
    """As VPR-Bench (Zaffar et al., IJCV 2021) hands it out, with its own truth where it is requested."""
    truth = ("ground_truth_new.npy", read_array) if own_truth else ()
    return folders("VPR-Bench", f"datasets/{name}", ("ref",), ("query",), *truth)


def vpr_tutorial(name: str, references: str, queries: str, masks: bool = False) -> DatasetLayout:
    """As VPR_Tutorial (Schubert et al., RAM 2023) downloads it; with ``masks`` its ``GT.npz`` says what is true."""
    found = folders("VPR_Tutorial", f"images/{name}", (references,), (queries,))
    if not masks:
        return found

    def read(base: Path) -> LayoutTraverses:
        plain = found.read(base)
        truth, excluded = read_masks(base / "GT.npz", plain.queries, plain.references)
        return LayoutTraverses(plain.references, plain.queries, truth, excluded)

    return DatasetLayout(found.publisher, found.home, (*found.holds, ("GT.npz",)), read, "GT.npz")


def located(root: Path, name: str) -> Path | None:
    """The image of a name below ``root``; None where it is missing, or where the name leads out of ``root``.

    The lists of Tokyo 24/7 say .jpg where its files are .png.
    """
    relative = Path(name.strip())
    if relative.is_absolute() or ".." in relative.parts or not relative.name:
        return None
    path = root / relative
    return next((one for one in (path, path.with_suffix(".png"), path.with_suffix(".jpg")) if isfile(one)), None)


def existing(root: Path, names: Sequence[str], listed_by: Path) -> list[Path]:
    """The images of a list, below ``root``.

    Raises:
        InvalidTraverse: there is none, or some are missing; the text says how many and names one.
    """
    found = [(name, located(root, name)) for name in names]
    missing = [name for name, path in found if path is None]
    if missing:
        raise InvalidTraverse(
            f"{len(missing)} of {len(names)} images that {listed_by} lists are missing below {root}; the first is "
            f"{missing[0][:200]!r}."
        )
    if not found:
        raise InvalidTraverse(f"{listed_by} lists no image.")
    return [path for _, path in found if path is not None]
