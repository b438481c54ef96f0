"""References for maps of 100 000 and 1 000 000 places, synthesized from real descriptors; real queries to ask of them.

Photographs of the data sets are encoded once by the default encoder.  A *distractor* mixes two photographs of
like places, A and one of the ten that score highest against A among those of A's kind (its folder): each word's part
is A's with probability 1/2, else B's; 0.8 of it with 0.6 of the other one's, scaled back to unit length; empty where
the first one's is.  These two numbers were chosen so that the best score of a real query among n distractors is
distributed as among n photographs of other real places (``python -m benchmarks.maps.search_plots`` draws both).

*Queries* are second looks that nothing here was made from: the second walks of corridor and lip6, every other frame of
five webcams and of floors of the tower, fixed cameras by night.  Their places, the first looks, come first among the
references; then distractors, of which row r is the same in every run, whichever block it is made in.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from core.frames.images import decode
from core.frames.traverses import natural_key
from core.method.encoder import Encoder

Array = NDArray[np.float32]

KINDS_BELOW = ("train/roads", "train/scenes15")
"""Folders whose subfolders are kinds of place; elsewhere the folder is the kind."""
SOURCES = ("train/roads", "train/scenes15", "train/tower", "train/camvid", "train/facades")
TOWER_FLOORS = ("basement2", "floor9", "floor12", "floor16", "floor20")
"""Left out of the sources: their frames are queries and places in turn."""
NEIGHBOURS, OTHERS_SHARE, OWN, OTHERS = 10, 0.5, 0.8, 0.6
SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp"}


@dataclass(frozen=True)
class Material:
    """Descriptors of real photographs.

    sources: float32 [s, D], the sources of distractors; kinds: int64 [s].
    neighbours: int64 [s, 10], like places of the same kind.
    queries, places: float32 [q, D], [p, D]: second and first looks.
    walks: int64 [q], which data set a query is of, an index into ``names``.
    """

    words: int
    sources: Array
    kinds: NDArray[np.int64]
    neighbours: NDArray[np.int64]
    queries: Array
    places: Array
    walks: NDArray[np.int64]
    names: tuple[str, ...]

    @property
    def dimension(self) -> int:
        """D."""
        return self.sources.shape[1]

    def references(self, start: int, stop: int) -> Array:
        """Rows start … stop of the references, float32 [stop - start, D]: the places, then distractors."""
        made = np.empty((stop - start, self.dimension), np.float32)
        real = self.places[start:stop]
        made[: len(real)] = real
        _recombine(self.sources, self.neighbours, self.words, start + len(real), made[len(real) :])
        return made

    def blocks(self, count: int, size: int, first: int = 0) -> Iterator[tuple[int, Array]]:
        """References ``first`` … ``count``, ``size`` at a time, each block with its first row."""
        for start in range(first, count, size):
            yield start, self.references(start, min(count, start + size))


@numba.njit(nogil=True, inline="always")
def _mixed(value):  # type: ignore[no-untyped-def]
    """SplitMix64's finalizer (Steele, Lea and Flood, 2014): 64 bits that look random, of a counter."""
    value = np.uint64(value) * np.uint64(0x9E3779B97F4A7C15)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@numba.njit(cache=True, nogil=True)
def _recombine(sources, neighbours, words, first, made):  # type: ignore[no-untyped-def]
    """Distractors of the rows ``first`` and on, into ``made``."""
    values = sources.shape[1] // words
    for offset in range(len(made)):
        drawn = _mixed(np.uint64(first + offset) * np.uint64(1024) + np.uint64(1))
        a = np.int64(drawn % np.uint64(len(sources)))
        b = neighbours[a, np.int64((drawn >> np.uint64(32)) % np.uint64(neighbours.shape[1]))]
        for u in range(words):
            chance = _mixed(np.uint64(first + offset) * np.uint64(1024) + np.uint64(2 + u)) >> np.uint64(40)
            swapped = np.float64(chance) < OTHERS_SHARE * 2.0**24
            main = sources[b if swapped else a, u * values : (u + 1) * values]
            other = sources[a if swapped else b, u * values : (u + 1) * values]
            part = made[offset, u * values : (u + 1) * values]
            filled, square = np.float32(0), np.float32(0)
            for k in range(values):
                filled += main[k] * main[k]
                part[k] = np.float32(OWN) * main[k] + np.float32(OTHERS) * other[k]
                square += part[k] * part[k]
            scale = np.float32(0) if filled == 0 or square == 0 else np.float32(1) / np.sqrt(square)
            for k in range(values):
                part[k] *= scale


def material(datasets: Path, encoder: Encoder, cache: Path) -> Material:
    """Encode all photographs, or take those of an earlier run from the folder ``cache`` (about half a gigabyte)."""
    paths = _photographs(datasets)
    names = [path.relative_to(datasets).as_posix() for path in paths]
    descriptors = _encoded(paths, encoder, cache)
    roles = _roles(names)
    source = [i for i, role in enumerate(roles) if role == "source"]
    query = [i for i, role in enumerate(roles) if role == "query"]
    kinds = np.unique([_kind(names[i]) for i in source], return_inverse=True)[1].astype(np.int64)
    sources = descriptors[source].astype(np.float32)
    sets = sorted({_kind(names[i]) for i in query})
    return Material(
        encoder.definition.words,
        sources,
        kinds,
        _neighbours(sources, kinds, cache / f"neighbours-{encoder.identity[-16:]}.npy"),
        descriptors[query].astype(np.float32),
        descriptors[[i for i, role in enumerate(roles) if role == "place"]].astype(np.float32),
        np.array([sets.index(_kind(names[i])) for i in query]),
        tuple(sets),
    )


def _photographs(datasets: Path) -> list[Path]:
    folders = (*SOURCES, "train/day_night", "eval/corridor", "eval/lip6_outdoor", "eval/webcams")
    found = [path for folder in folders for path in (datasets / folder).rglob("*") if path.suffix.lower() in SUFFIXES]
    return sorted(found, key=lambda path: (str(path.parent), natural_key(path.name)))


def _kind(name: str) -> str:
    """The folder that a photograph belongs to, by its path in the data sets."""
    depth = 3 if name.startswith(KINDS_BELOW) else 2
    return "/".join(name.split("/")[:depth])


def _roles(names: Sequence[str]) -> list[str]:
    """``source``, ``query`` or ``place`` of each photograph, by its path in the data sets alone."""
    turns: dict[str, int] = {}
    return [_role(name, turns) for name in names]


def _role(name: str, turns: dict[str, int]) -> str:
    _, source, *rest = name.split("/")
    if source in ("corridor", "lip6_outdoor"):
        return "query" if rest[0] == "query" else "place"
    if source == "day_night":
        return "query" if rest[-1].startswith("night") else "place"
    if source == "webcams" or (source == "tower" and rest[0] in TOWER_FLOORS):  # first a place, then a query, …
        turns[rest[0]] = turns.get(rest[0], 0) + 1
        return "place" if turns[rest[0]] % 2 else "query"
    return "source"


def _encoded(paths: Sequence[Path], encoder: Encoder, cache: Path) -> NDArray[np.float16]:
    """Descriptors of photographs, float16 [n, D]."""
    stored = cache / f"descriptors-{encoder.identity[-16:]}.npy"
    if stored.exists():
        descriptors: NDArray[np.float16] = np.load(stored, mmap_mode="r")
        if len(descriptors) == len(paths):
            return descriptors
    cache.mkdir(parents=True, exist_ok=True)
    made = np.empty((len(paths), encoder.dimension), np.float16)
    for start in track(range(0, len(paths), 8), "encoding photographs"):
        frames = [decode(path.read_bytes()) for path in paths[start : start + 8]]
        made[start : start + 8] = [encoding.descriptor for encoding in encoder.encode_batch(frames)]
    np.save(stored, made)
    return made


def _neighbours(sources: Array, kinds: NDArray[np.int64], stored: Path) -> NDArray[np.int64]:
    """Of each source the ten of its kind that score highest against it, int64 [s, 10]."""
    if stored.exists():
        found: NDArray[np.int64] = np.load(stored)
        if len(found) == len(sources):
            return found
    found = np.empty((len(sources), NEIGHBOURS), np.int64)
    for kind in range(int(kinds.max()) + 1):
        members = np.flatnonzero(kinds == kind)
        scores = sources[members] @ sources[members].T
        np.fill_diagonal(scores, -np.inf)
        found[members] = members[np.argsort(-scores, axis=1, kind="stable")[:, :NEIGHBOURS]]
    np.save(stored, found)
    return found
