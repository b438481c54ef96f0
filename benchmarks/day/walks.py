"""The walks at hand: the frames of the map, the later frames of a robot, and the places that each of these shows."""

from __future__ import annotations

import csv
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.process import ROOT
from core.frames.images import decode
from core.frames.preprocessing import Pixels
from lab.training.ground_truth import corrected_truth
from lab.training.photographs import MIXED_CAMERAS, find_photographs

METRES = 2.0
"""Between two frames of a map, so that the default radius of one place, 5 m, is two frames, as the truth tolerates."""

BEND, BEND_METRES = 0.6, 40.0
"""The made-up curve winds: its heading is BEND · sin(metres / BEND_METRES), in radians."""


class PlanarPose(NamedTuple):
    """Metres, and radians counter-clockwise from +x."""

    x: float
    y: float
    heading: float


@dataclass(frozen=True)
class WalkPair:
    """Two traverses of the same places.

    references: files of the traverse that the map is made of.
    frames: files of the other one, in order.
    shown: bool [frames, references]: which reference shows the place of a frame.
    strangers: files of pictures from elsewhere, in order.
    spacing: metres between two references.
    """

    name: str
    references: Sequence[bytes]
    frames: Sequence[bytes]
    shown: NDArray[np.bool_]
    strangers: Sequence[bytes]
    spacing: float = METRES

    @cached_property
    def metres(self) -> NDArray[np.float64]:
        """Where along the curve each frame was taken, float64 [frames]."""
        return self.spacing * self.shown @ np.arange(self.shown.shape[1]) / np.maximum(self.shown.sum(axis=1), 1)

    def where(self, at: float) -> float:
        """Metres along the curve of a place between two frames of the robot's walk."""
        return float(np.interp(at, np.arange(len(self.frames)), self.metres))

    def right(self, at: float) -> frozenset[int]:
        """The references that show a place of the robot's walk."""
        return frozenset(np.flatnonzero(self.shown[round(at)]).tolist())

    def reference(self, at: float) -> int:
        """The reference in the middle of those."""
        return round(self.where(at) / self.spacing)

    @cached_property
    def _curve(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Every tenth of a metre, and x + iy there."""
        along = np.arange(0, 3 * self.spacing * len(self.references) + 1000, 0.1)
        return along, np.cumsum(0.1 * np.exp(1j * BEND * np.sin(along / BEND_METRES)))

    def pose(self, metres: float, aside: float = 0.0) -> PlanarPose:
        """The pose at ``metres`` along the curve, ``aside`` metres to its left."""
        along, points = self._curve
        heading = BEND * float(np.sin(metres / BEND_METRES))
        x, y = (float(np.interp(metres, along, part)) for part in (points.real, points.imag))
        return PlanarPose(x - aside * np.sin(heading), y + aside * np.cos(heading), heading)


def pixels(data: bytes) -> Pixels:
    """The pixels of a file, uint8 [H, W, 3], BGR."""
    return decode(data)


def _files(folder: Path, count: int | None = None) -> list[bytes]:
    return [path.read_bytes() for path in find_photographs(folder)[:count]]


def _stated(folder: Path, frames: int, references: int) -> NDArray[np.bool_]:
    shown = np.zeros((frames, references), np.bool_)
    rows = np.loadtxt(folder / "ground_truth.csv", np.int64, delimiter=",", skiprows=1)
    shown[rows[:, 0], rows[:, 1]] = True
    return shown


def corridor(datasets: Path) -> WalkPair:
    """A corridor indoors, twice; two frames are tolerated."""
    folder = datasets / "eval/corridor"
    frames, references = _files(folder / "query"), _files(folder / "ref")
    shown = _stated(folder, len(frames), len(references))
    return WalkPair("corridor", references, frames, shown, _files(datasets / "eval/lip6_outdoor/query", 60))


def lip6(datasets: Path) -> WalkPair:
    """Streets of Paris, the part of them that was walked once in each loop; the truth put right by local features."""
    folder = datasets / "eval/lip6_outdoor"
    frames, references = _files(folder / "query", 110), _files(folder / "reference")
    retained = slice(140, 270)
    stated = _stated(folder, 455, len(references))[: len(frames), retained]
    references = references[retained]
    shown = corrected_truth([decode(one) for one in frames], [decode(one) for one in references], stated)
    return WalkPair("lip6", references, frames, shown, _files(datasets / "eval/corridor/query", 60))


def nordland(datasets: Path, frames: int = 1500) -> WalkPair:
    """A railway in summer and in winter, 64 x 32 pixels; fifteen frames are tolerated, as is customary."""
    folder = datasets / "eval/nordland_tiny"
    shown = np.abs(np.arange(frames)[:, None] - np.arange(frames)) <= 15
    summer, winter = (_files(folder / season, frames) for season in ("summer", "winter"))
    return WalkPair("nordland", summer, winter, shown, _files(datasets / "eval/corridor/query", 60))


def night(datasets: Path) -> WalkPair:
    """Fixed cameras, one place each, in one order: the map by day, the robot by night."""
    folder = datasets / "train/day_night"
    cameras = sorted(one for one in folder.iterdir() if one.is_dir() and one.name not in MIXED_CAMERAS)
    by_day, by_night = ([sorted(one.glob(f"{light}_*"))[:1] for one in cameras] for light in ("day", "night"))
    both = [(day[0], dark[0]) for day, dark in zip(by_day, by_night, strict=True) if day and dark]
    references, frames = ([path.read_bytes() for path in side] for side in zip(*both, strict=True))
    shown = np.eye(len(both), dtype=np.bool_)
    return WalkPair("night", references, frames, shown, _files(datasets / "eval/corridor/query", 60), spacing=20.0)


def drawn(_datasets: Path = Path()) -> WalkPair:
    """The two walks that the examples draw; it needs no data. A frame shows its step and the two on either side."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        for program in ("make_pictures.py", "make_walks.py"):
            subprocess.run([sys.executable, ROOT / "examples" / program], cwd=folder, check=True, capture_output=True)
        references = _files(folder / "monday")
        ids = [path.stem for path in find_photographs(folder / "monday")]
        with (folder / "tuesday/labels.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        known = [row for row in rows if row["place"]]
        frames, strangers = (
            [(folder / "tuesday" / row["file"]).read_bytes() for row in rows if bool(row["place"]) is there]
            for there in (True, False)
        )
    at = np.array([ids.index(row["place"].removeprefix("monday-")) for row in known])
    columns = np.arange(len(references))
    shown = np.abs(at[:, None] - columns) <= 2
    return WalkPair("drawn", references, frames, shown, strangers)


WALKS: dict[str, Callable[[Path], WalkPair]] = {
    "corridor": corridor,
    "lip6": lip6,
    "nordland": nordland,
    "night": night,
    "drawn": drawn,
}
